"""The numpy backend: tiles of the image, each blended front to back, a slab of Gaussians at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.gaussians import Gaussians
from bathyscope.splat.plain_projection import Footprints, colours_towards, footprints, principal_axes, spread
from bathyscope.splat.rendering import Floats, Projection, Rendering
from bathyscope.splat.settings import SplatSettings
from bathyscope.splat.view import View

TILE = 8
"""Pixels along the side of a tile; measured best for Gaussians of a few pixels."""
SLAB = 512
"""Gaussians blended before asking whether a tile is finished."""
OPACITY_FLOOR = 1e-10
"""What the depth is divided by where nothing was blended."""


@dataclass(frozen=True, slots=True)
class PlainScene:
    """A scene with its principal axes worked out."""

    gaussians: Gaussians
    means: Floats
    axes: Floats
    opacities: Floats

    @classmethod
    def of(cls, scene: Gaussians, settings: SplatSettings) -> PlainScene:
        """Prepare ``scene`` in the precision of ``settings``."""
        dtype: type[np.floating[Any]] = np.float64 if settings.precision == "float64" else np.float32
        return cls(scene, scene.means.astype(dtype), principal_axes(scene, dtype), scene.opacities.astype(dtype))

    def project(self, view: View, settings: SplatSettings, degree: int | None) -> Projection:
        """All Gaussians seen by ``view``; colours only if there is a ``degree``."""
        found = footprints(self.means, self.axes, self.opacities, view, settings)
        return spread(found, self._colours(found, view, degree), len(self.gaussians))

    def render(self, view: View, settings: SplatSettings, degree: int | None, background: Floats | None) -> Rendering:
        """One view; colour only if there is a ``degree``."""
        found = footprints(self.means, self.axes, self.opacities, view, settings)
        colours = self._colours(found, view, degree)
        features = np.ones((len(found.index), 2 if colours is None else 5), self.means.dtype)
        features[:, 1] = found.depths
        if colours is not None:
            features[:, 2:] = colours
        blended = _blend(found, features, view, settings)
        opacity, accumulated = blended[..., 0], blended[..., 1]
        image = None
        if colours is not None:
            image = blended[..., 2:]
            if background is not None:
                image = image + (1 - opacity)[..., None] * background.astype(image.dtype)
        return Rendering(image, accumulated / np.maximum(opacity, OPACITY_FLOOR), accumulated, opacity)

    def _colours(self, found: Footprints, view: View, degree: int | None) -> Floats | None:
        if degree is None:
            return None
        return colours_towards(self.means[found.index], self.gaussians.harmonics[found.index], view, degree)


def _blend(found: Footprints, features: Floats, view: View, settings: SplatSettings) -> Floats:
    """(h, w, f) features of the Gaussians, weighted by what each adds to each pixel."""
    height, width = view.size
    rows, columns = -(-height // TILE), -(-width // TILE)
    out = np.zeros((rows, columns, TILE * TILE, features.shape[1]), features.dtype)
    members, starts = _tile_lists(found, view, settings)
    within = np.arange(TILE * TILE)
    for tile in np.flatnonzero(np.diff(starts)):
        row, column = divmod(int(tile), columns)
        u = (column * TILE + within % TILE + 0.5).astype(features.dtype)
        v = (row * TILE + within // TILE + 0.5).astype(features.dtype)
        out[row, column] = _blend_tile(members[starts[tile] : starts[tile + 1]], u, v, found, features, settings)
    image = out.reshape(rows, columns, TILE, TILE, -1).swapaxes(1, 2).reshape(rows * TILE, columns * TILE, -1)
    return np.ascontiguousarray(image[:height, :width])


def _tile_lists(found: Footprints, view: View, settings: SplatSettings) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Members of all tiles, front to back within a tile (ties by index), and where each tile's list starts."""
    height, width = view.size
    order = np.argsort(found.depths, kind="stable")
    ratio = np.maximum(found.opacities[order] / settings.alpha_threshold, 1)
    reach = np.sqrt(2 * np.log(ratio))[:, None] * np.sqrt(found.covariances[order, :2])
    last = np.array([width, height]) - 1
    # A hundredth of a pixel more than the ellipse, for rounding.
    first_tile = np.clip(np.ceil(found.means[order] - reach - 0.51), 0, last).astype(np.intp) // TILE
    last_tile = np.clip(np.floor(found.means[order] + reach - 0.49), 0, last).astype(np.intp) // TILE
    spans = last_tile - first_tile + 1
    counts = spans.prod(-1)
    columns = -(-width // TILE)
    entry = np.repeat(np.arange(len(order)), counts)
    step = np.arange(len(entry)) - np.repeat(np.cumsum(counts) - counts, counts)
    tile = (first_tile[entry, 1] + step // spans[entry, 0]) * columns + first_tile[entry, 0] + step % spans[entry, 0]
    by_tile = np.argsort(tile, kind="stable")
    tiles = -(-height // TILE) * columns
    starts = np.concatenate([[0], np.cumsum(np.bincount(tile, minlength=tiles))])
    return order[entry[by_tile]], starts


def _blend_tile(
    members: NDArray[np.intp], u: Floats, v: Floats, found: Footprints, features: Floats, settings: SplatSettings
) -> Floats:
    """(p, f) blended features of the pixels (u, v) of one tile (step 8 of ``docs/splatting.md``)."""
    left = np.ones_like(u)
    out = np.zeros((len(u), features.shape[1]), features.dtype)
    for start in range(0, len(members), SLAB):
        slab = members[start : start + SLAB]
        dx = u - found.means[slab, 0, None]
        dy = v - found.means[slab, 1, None]
        a, b, c = found.conics[slab].T[..., None]
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = np.minimum(found.opacities[slab, None] * np.exp(-np.maximum(sigma, 0)), settings.max_alpha)
        alpha[(alpha < settings.alpha_threshold) | (sigma < 0)] = 0
        after = left * np.cumprod(1 - alpha, axis=0)
        before = np.concatenate([left[None], after[:-1]])
        weights = np.where(after > settings.transmittance_cutoff, alpha * before, 0)
        out += weights.T @ features[slab]
        left = np.where(after[-1] > settings.transmittance_cutoff, after[-1], 0)
        if not left.any():
            break
    return out

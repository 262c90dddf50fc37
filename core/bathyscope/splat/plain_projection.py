"""Projecting Gaussians into a camera, in plain numpy: the readable reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope.splat.harmonics import harmonic_terms
from bathyscope.splat.rendering import Floats, Projection
from bathyscope.splat.settings import SplatSettings
from bathyscope.splat.view import View

REACH_CAP = 3.33
"""Standard deviations; where even an opacity of 1 has fallen to 1/255."""


@dataclass(frozen=True, slots=True)
class Footprints:
    """The visible m of n Gaussians as the image sees them, in the order of the scene."""

    index: NDArray[np.intp]
    means: Floats
    """(m, 2) centres, px."""
    covariances: Floats
    """(m, 3) variances of u and v and their covariance, dilated, px^2."""
    conics: Floats
    """(m, 3)"""
    depths: Floats
    opacities: Floats
    """(m,) with the compensation in it."""
    compensations: Floats
    radii: NDArray[np.int32]


def principal_axes(scene: Gaussians, dtype: type[np.floating[Any]]) -> Floats:
    """(n, 3, 3) the axes of the Gaussians as columns, each as long as its standard deviation: R(q) diag(s)."""
    q = scene.rotations.astype(dtype)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = np.stack([np.stack(row, -1) for row in rows], -2)
    return np.asarray(rotation * scene.scales.astype(dtype)[:, None, :])


def footprints(means: Floats, axes: Floats, opacities: Floats, view: View, settings: SplatSettings) -> Footprints:
    """The Gaussians that the image can show, projected (steps 1 to 7 of ``docs/splatting.md``)."""
    dtype = means.dtype.type
    focal, principal = view.focal.astype(dtype), view.principal.astype(dtype)
    rotation = view.rotation.astype(dtype)
    points = means @ rotation.T + view.translation.astype(dtype)
    between = (points[:, 2] >= settings.near_plane) & (points[:, 2] <= settings.far_plane)
    opaque = opacities >= settings.alpha_threshold
    index = np.flatnonzero(between & opaque)
    points, opacity = points[index], opacities[index]

    z = points[:, 2:]
    slopes = points[:, :2] / z
    centres = focal * slopes + principal
    clamped = np.clip(slopes, view.lower.astype(dtype), view.upper.astype(dtype))
    # The rows of J R: how u and v move with a step in the world.
    steps = (focal / z)[..., None] * (rotation[:2] - clamped[..., None] * rotation[2])
    spans = steps @ axes[index]
    variances = (spans * spans).sum(-1) + dtype(settings.eps2d)
    covariance = (spans[:, 0] * spans[:, 1]).sum(-1)
    # Determinants as sums of squares (Cauchy-Binet): a difference would lose thin Gaussians to rounding.
    minors = np.cross(spans[:, 0], spans[:, 1])
    before = (minors * minors).sum(-1)
    eps = dtype(settings.eps2d)
    determinant = before + eps * (variances.sum(-1) - eps)
    solid = determinant > 0
    safe = np.where(solid, determinant, 1)
    compensation = np.sqrt(before / safe) if settings.antialiased else np.ones_like(opacity)
    opacity = opacity * compensation

    sigmas = np.sqrt(2 * np.log(np.maximum(opacity, settings.alpha_threshold) / dtype(settings.alpha_threshold)))
    radii = np.ceil(np.minimum(sigmas, REACH_CAP)[:, None] * np.sqrt(variances))
    sides = np.array(view.size[::-1], dtype)
    inside = (centres + radii > 0) & (centres - radii < sides)
    keep = inside.all(-1) & (radii > settings.radius_clip).any(-1)
    keep &= solid & (opacity >= settings.alpha_threshold)

    conics = np.stack([variances[:, 1], -covariance, variances[:, 0]], -1) / safe[:, None]
    covariances = np.concatenate([variances, covariance[:, None]], -1)
    return Footprints(
        index[keep],
        centres[keep],
        covariances[keep],
        conics[keep],
        points[keep, 2],
        opacity[keep],
        compensation[keep],
        np.minimum(radii[keep], 2**30).astype(np.int32),
    )


def colours_towards(means: Floats, harmonics: Floats, view: View, degree: int) -> Floats:
    """(m, 3) colour of Gaussians seen from the camera, not below 0.

    Raises:
        GeometryError: If a coefficient is not finite.
    """
    dtype = means.dtype.type
    away = means - view.centre.astype(dtype)
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), np.finfo(dtype).tiny)
    terms = np.stack(harmonic_terms(away[:, 0], away[:, 1], away[:, 2], degree), -1)
    colours = np.einsum("nk,nkc->nc", terms, harmonics[:, : (degree + 1) ** 2].astype(dtype)) + dtype(0.5)
    if not np.isfinite(colours).all():
        raise GeometryError("harmonics of visible Gaussians have values that are not finite; render without colour")
    return np.asarray(np.maximum(colours, 0))


def spread(found: Footprints, colours: Floats | None, count: int) -> Projection:
    """The projection of all ``count`` Gaussians: NaN where not visible."""

    def fill(values: Floats) -> Floats:
        whole = np.full((count, *values.shape[1:]), np.nan, values.dtype)
        whole[found.index] = values
        return whole

    radii = np.zeros((count, 2), np.int32)
    radii[found.index] = found.radii
    visible = np.zeros(count, np.bool_)
    visible[found.index] = True
    return Projection(
        fill(found.means),
        fill(found.conics),
        fill(found.depths),
        fill(found.compensations),
        radii,
        visible,
        None if colours is None else fill(colours),
    )

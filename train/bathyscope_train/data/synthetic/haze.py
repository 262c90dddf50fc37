r"""Smoke and haze: a veil that grows with distance.

Light from depth z is weakened by :math:`T = e^{-m z / L}` and the smoke's own light is added:
:math:`I' = T I + (1 - T) V`. Here :math:`L` is chosen so that T = 1 - ``opacity`` at ``depth_mm`` with m = 1, and the
wisps m are a product of slow waves over the image, drifting with the frames.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import AirRanges, draw

Array = npt.NDArray[np.float32]

_LEAST = 0.15  # what a wisp leaves of the density at least


class Haze(NamedTuple):
    """Smoke of one clip."""

    opacity: float = 0.0
    """Share of light lost at the reference depth; 0 is clear air."""
    veil: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Light of the smoke against the metered radiance."""
    wisps: float = 0.0
    waves: tuple[tuple[float, float, float, float], ...] = ()
    """Of each wave: turns over the image's width along x and y, turns a frame, phase in turns."""


CLEAR = Haze()


def draw_haze(random: np.random.Generator, ranges: AirRanges) -> Haze:
    """Draw the air of one clip."""
    if random.uniform() >= ranges.smoky:
        return CLEAR
    veil = draw(random, ranges.veil)
    blue = random.uniform(0.9, 1.15)
    waves = [
        (random.uniform(-1.6, 1.6), random.uniform(-1.6, 1.6), random.uniform(-0.03, 0.03), random.uniform())
        for _ in range(3)
    ]
    return Haze(
        opacity=draw(random, ranges.opacity),
        veil=(veil * random.uniform(0.9, 1.15), veil, veil * blue),
        wisps=draw(random, ranges.wisps),
        waves=tuple(waves),
    )


def add_haze(radiance: Array, depth: Array, haze: Haze, frame: int, *, depth_mm: float, metered: float) -> Array:
    """One frame seen through the smoke.

    Args:
        radiance: ``(h, w, 3)``.
        depth: ``(h, w)``; 0 counts as far away.
        haze: The clip's smoke.
        frame: Number of the frame.
        depth_mm: Depth at which its opacity holds: the median of the clip's first frame.
        metered: Luminance that the veil is measured in.
    """
    height, width = depth.shape
    v, u = np.mgrid[:height, :width].astype(np.float32) / np.float32(width)
    thickness = np.ones_like(depth)
    for across, along, speed, phase in haze.waves:
        thickness *= 1.0 + np.float32(haze.wisps) * np.sin(
            np.float32(2 * np.pi) * (np.float32(across) * u + np.float32(along) * v + np.float32(speed * frame + phase))
        )
    reach = np.where(depth > 0, depth, np.float32(4 * depth_mm)) / np.float32(depth_mm)
    passed = (np.float32(1 - haze.opacity) ** (reach * np.maximum(thickness, _LEAST)))[..., None]
    veil = np.float32(metered) * np.asarray(haze.veil, np.float32)
    return np.asarray(radiance * passed + (1 - passed) * veil, np.float32)

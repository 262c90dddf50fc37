"""Organ-like cavities: blobs on a tilted ground inside a surrounding wall, as a depth map over (y, x)."""

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.noise import periodic_noise
from bathyscope_train.data.synthetic.scene import FIELD, Scene, make_surface
from bathyscope_train.data.synthetic.tissue import blend, make_tissue, palette, without_streaks

Array = npt.NDArray[np.float32]

_SAMPLES = 400


def cavity(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """Four to eleven rounded organs, each with its own colour, 25 to 110 mm ahead."""
    extent = random.uniform(120.0, 240.0)
    step = extent / _SAMPLES
    axis = (np.arange(_SAMPLES, dtype=np.float32) + 0.5) * np.float32(step) - np.float32(extent / 2)
    y, x = axis[:, None], axis[None, :]
    ground = extent * random.uniform(0.3, 0.5)
    tilt = random.uniform(-0.3, 0.3, 2)
    waves = periodic_noise(random, (_SAMPLES, _SAMPLES), (step, step), grain_mm=extent / 6)
    heights = np.asarray(ground + tilt[0] * x + tilt[1] * y + 0.02 * extent * waves, np.float32)

    tint = material.variety[0] + (material.variety[1] - material.variety[0]) * random.uniform()
    base = palette(random, material)
    albedo = np.broadcast_to(base, (*heights.shape, 3)).copy()
    for _ in range(int(random.integers(4, 12))):
        organ = _organ(random, x, y, heights, extent)
        wins = organ < heights
        colour = blend(base, palette(random, material), np.asarray(min(1.0, 2.5 * tint), np.float32))
        albedo[wins] = colour
        heights = np.minimum(heights, organ)
    folds = periodic_noise(random, (_SAMPLES, _SAMPLES), (step, step), grain_mm=extent / 24)
    heights += np.float32(0.0017 * extent * folds)
    heights -= _wall(random, x, y, extent)
    heights = np.asarray(cv2.GaussianBlur(heights, (0, 0), 1.4, borderType=cv2.BORDER_REPLICATE), np.float32)
    albedo = np.asarray(cv2.GaussianBlur(albedo, (0, 0), 1.2), np.float32)
    surface = make_surface(
        FIELD,
        heights,
        first=(float(axis[0]), float(axis[0])),
        step=(step, step),
        stride_mm=2.5,
        feature_mm=0.03 * extent,
    )
    tissue = make_tissue(
        random, material, np.asarray(albedo, np.float32), (extent, extent), wrap=False, vessel_step_mm=0.3, grain=1.6
    )
    if material.fading:
        tissue = without_streaks(tissue, np.asarray(albedo, np.float32), surface)
    return Scene("cavity", surface, tissue)


def _organ(random: np.random.Generator, x: Array, y: Array, ground: Array, extent: float) -> Array:
    """Depth of one ellipsoid that stands on the ground; infinite beside it."""
    centre = random.uniform(-0.33, 0.33, 2) * extent
    size = random.uniform(0.06, 0.24, 2) * extent
    turn = random.uniform(0, np.pi)
    cosine, sine = np.float32(np.cos(turn)), np.float32(np.sin(turn))
    along, across = x - np.float32(centre[0]), y - np.float32(centre[1])
    inside = 1.0 - ((cosine * along + sine * across) / size[0]) ** 2 - ((cosine * across - sine * along) / size[1]) ** 2
    foot = float(np.median(ground))
    height = random.uniform(0.5, 1.3) * float(size.min())
    top = foot + 0.2 * height - height * np.sqrt(np.clip(inside, 0.0, 1.0)) - random.uniform(0.0, 0.06) * extent
    return np.asarray(np.where(inside > 0, top, np.inf), np.float32)


def _wall(random: np.random.Generator, x: Array, y: Array, extent: float) -> Array:
    """How much nearer the surrounding wall brings the surface: 0 in the middle, past the camera outside."""
    stretch = random.uniform(0.8, 1.25)
    radius = np.sqrt((x * stretch) ** 2 + (y / stretch) ** 2) / extent
    beyond = np.clip((radius - random.uniform(0.3, 0.36)) / 0.14, 0.0, None)
    border = np.clip((np.maximum(np.abs(x), np.abs(y)) / extent - 0.38) / 0.08, 0.0, None)
    return np.asarray(0.75 * extent * np.maximum(beyond, border) ** 1.8, np.float32)

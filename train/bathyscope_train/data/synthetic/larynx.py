"""A larynx from above: epiglottis, false and true vocal folds, arytenoids, and the dark glottis between them."""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.noise import periodic_noise
from bathyscope_train.data.synthetic.scene import FIELD, Scene, Stage, make_surface, smooth_field
from bathyscope_train.data.synthetic.tissue import blend, make_tissue, palette, without_streaks

Array = npt.NDArray[np.float32]

_SAMPLES = 448
_EXTENT_MM = 62.0
_FOLDS_MM = 58.0  # depth of the true vocal folds


def _rise(value: npt.NDArray[np.floating]) -> Array:
    """Smooth step from 0 to 1 over the unit interval."""
    inside = np.clip(value, 0.0, 1.0)
    return np.asarray(inside * inside * (3.0 - 2.0 * inside), np.float32)


def larynx(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """Folds meet in front (y < 0) and part behind by a gap that may be nearly shut."""
    step = _EXTENT_MM / _SAMPLES
    axis = (np.arange(_SAMPLES, dtype=np.float32) + 0.5) * np.float32(step) - np.float32(_EXTENT_MM / 2)
    bend = periodic_noise(random, (_SAMPLES,), (step,), grain_mm=25.0)
    y = axis[:, None]
    x = axis[None, :] + np.float32(random.uniform(0.0, 0.8)) * bend[:, None]
    rough = periodic_noise(random, (_SAMPLES, _SAMPLES), (step, step), grain_mm=6.0)

    length = random.uniform(13.0, 20.0)
    front, back = -0.55 * length, 0.45 * length
    along = (y - front) / (back - front)
    gap = random.uniform(0.15, 3.8) * np.clip(along, 0.0, 1.0) ** random.uniform(0.7, 1.3)
    gap = np.where(along > 1.0, gap * np.clip(1.0 - 3.0 * (along - 1.0), 0.0, 1.0), gap)
    aside = np.abs(x)
    breadth = random.uniform(2.2, 3.6)  # of a true fold

    heights = _FOLDS_MM + 0.25 * rough + 0.9 * np.clip(aside - gap, 0.0, breadth) / breadth
    ventricle = np.exp(-(((aside - gap - breadth - 0.5) / 0.9) ** 2)) * _rise(1.5 - np.abs(2 * along - 1))
    heights += random.uniform(1.5, 5.0) * ventricle
    false_fold = _rise((aside - gap - breadth - 0.4) / random.uniform(2.0, 3.5))
    heights -= random.uniform(4.0, 8.0) * false_fold
    oval = np.sqrt((x / random.uniform(0.8, 1.0)) ** 2 + ((y - 1.0) / random.uniform(1.0, 1.3)) ** 2)
    vestibule = random.uniform(8.5, 11.0)
    heights -= random.uniform(10.0, 18.0) * _rise((oval - vestibule) / random.uniform(4.0, 8.0))
    slit = _rise(0.5 + (gap - aside) / 0.7) * (along > -0.02) * (along < 1.34)
    heights += random.uniform(16.0, 45.0) * slit

    share = 0.2 + 0.15 * rough
    pale = _rise(1.5 - np.abs(aside - gap - 0.4 * breadth) / (0.6 * breadth)) * _rise(2.5 - np.abs(4 * along - 2))
    for side in (-1.0, 1.0):  # arytenoids
        width = random.uniform(2.6, 4.2)
        middle = side * (float(gap.max()) + random.uniform(2.5, 4.0))
        knob = ((x - middle) / width) ** 2 + ((y - back - 2.5) / (1.1 * width)) ** 2
        heights -= random.uniform(5.0, 10.0) * np.sqrt(np.clip(1.0 - knob, 0.0, 1.0))
        share = share + 0.4 * np.clip(1.0 - knob, 0.0, 1.0)
    heights -= _epiglottis(random, x, y, front)
    heights -= _throat(random, x, y)
    heights = smooth_field(heights, 1.6)

    base, redder = palette(random, material), palette(random, material)
    white = np.clip(base ** np.float32(0.35) * np.array([1.0, 0.93, 0.85], np.float32), 0.0, 0.95)
    albedo = blend(base, redder, np.clip(share, 0, 1))
    albedo = blend(albedo, np.sort(white)[::-1].copy(), np.clip(random.uniform(0.4, 1.0) * pale, 0, 1))
    surface = make_surface(
        FIELD, heights, first=(float(axis[0]), float(axis[0])), step=(step, step), stride_mm=0.9, feature_mm=1.6
    )
    size_mm = (_EXTENT_MM, _EXTENT_MM)
    tissue = make_tissue(random, material, albedo, size_mm, wrap=False, vessel_step_mm=0.12, grain=0.6)
    stage = Stage((0.0, 0.0, _FOLDS_MM), (4.0, 5.0, 3.0), (9.0, 34.0), (0.0, 28.0), margin_mm=2.2)
    return Scene("larynx", surface, without_streaks(tissue, albedo, surface), stage=stage)


def _epiglottis(random: np.random.Generator, x: Array, y: Array, front: float) -> Array:
    """Height of a leaf that stands across the view in front of the folds, curled round them."""
    curl = random.uniform(9.0, 18.0)
    middle = front - random.uniform(4.0, 8.0) + x**2 / (2 * curl)
    leaf = np.exp(-(np.abs((y - middle) / random.uniform(1.2, 2.2)) ** 2.5))
    wide = np.clip(1.0 - (x / random.uniform(9.0, 13.0)) ** 2, 0.0, 1.0)
    slope = 0.35 * np.clip(middle - y, 0.0, 12.0)
    return np.asarray(random.uniform(12.0, 24.0) * leaf * np.sqrt(wide) + slope, np.float32)


def _throat(random: np.random.Generator, x: Array, y: Array) -> Array:
    """How much nearer the wall of the throat brings the surface: past the camera outside."""
    radius = np.hypot(x / random.uniform(0.95, 1.1), y / random.uniform(0.95, 1.15))
    beyond = np.clip((radius - random.uniform(17.0, 20.0)) / 8.0, 0.0, None)
    return np.asarray(42.0 * beyond**1.3, np.float32)

"""A nasal passage seen along its way: a wall on one side, smooth turbinates that bulge into it, dark clefts between."""

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.noise import periodic_noise
from bathyscope_train.data.synthetic.scene import FIELD, Scene, Stage, make_surface, smooth_field
from bathyscope_train.data.synthetic.tissue import blend, make_tissue, palette, without_streaks

Array = npt.NDArray[np.float32]

_SAMPLES = 448


def passage(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """Two side walls that close in with depth, a floor and a roof, one to four turbinates between them."""
    extent = random.uniform(26.0, 44.0)
    step = extent / _SAMPLES
    axis = (np.arange(_SAMPLES, dtype=np.float32) + 0.5) * np.float32(step) - np.float32(extent / 2)
    y, x = axis[:, None], axis[None, :]
    bow = [random.uniform(0.3, 1.2) * periodic_noise(random, (_SAMPLES,), (step,), grain_mm=14.0) for _ in range(2)]
    rough = periodic_noise(random, (_SAMPLES, _SAMPLES), (step, step), grain_mm=5.0)

    wide, tall = random.uniform((0.13, 0.24), (0.3, 0.36)) * extent
    deep = random.uniform(0.8, 1.3) * extent
    across = np.where(x > 0, (x + bow[0][:, None]) / wide, -(x + bow[1][:, None]) / (wide * random.uniform(0.6, 1.0)))
    upward = np.abs(y) / tall
    radius = (np.clip(across, 0, None) ** 3 + upward**3) ** (1 / 3)
    inside = np.clip(radius, 0.0, 1.0)
    heights = deep * (1.0 - 0.45 * inside ** random.uniform(1.5, 4.0)) + 0.25 * rough
    heights -= random.uniform(1.2, 2.2) * extent * np.clip(radius - 1.0, 0.0, None) ** random.uniform(0.9, 1.3)

    base, other = palette(random, material), palette(random, material)
    share = np.asarray(0.15 * np.clip(rough, 0, 1) + 0.2 * np.clip(radius - 1.0, 0.0, 1.0), np.float32)
    for _ in range(int(random.integers(1, 5))):
        side = random.choice([-1.0, 1.0])
        size = random.uniform((0.06, 0.1), (0.2, 0.3)) * extent
        centre = side * random.uniform(0.3, 1.1) * wide, random.uniform(-0.7, 0.7) * tall
        turn = random.uniform(-0.5, 0.5)
        a = np.cos(turn) * (x - centre[0]) + np.sin(turn) * (y - centre[1])
        b = np.cos(turn) * (y - centre[1]) - np.sin(turn) * (x - centre[0])
        a = a + random.uniform(-0.3, 0.3) * b**2 / size[1]
        cap = np.clip(1.0 - (a / size[0]) ** 2 - (b / size[1]) ** 2, 0.0, 1.0)
        front = random.uniform(0.3, 0.75) * deep
        top = front + (1.0 - np.sqrt(cap)) * random.uniform(0.6, 1.6) * size[1] - 0.15 * rough
        bulge = np.where(cap > 0, top, np.inf)
        wins = bulge < heights
        share[wins] = random.uniform(0.1, 1.0)
        heights = np.minimum(heights, bulge)
    heights = smooth_field(heights, 2.2)
    share = np.asarray(cv2.GaussianBlur(share, (0, 0), 2.0), np.float32)
    surface = make_surface(
        FIELD, heights, first=(float(axis[0]), float(axis[0])), step=(step, step), stride_mm=0.7, feature_mm=2.0
    )
    albedo = blend(base, other, np.clip(share, 0, 1))
    tissue = make_tissue(random, material, albedo, (extent, extent), wrap=False, vessel_step_mm=0.1, grain=0.6)
    spread = (0.5 * wide, 0.5 * tall, 0.0)
    stage = Stage((0.0, 0.0, 0.62 * deep), spread, (0.25 * deep, 0.75 * deep), (0.0, 22.0), margin_mm=0.035 * extent)
    return Scene("sinus", surface, without_streaks(tissue, albedo, surface), stage=stage)

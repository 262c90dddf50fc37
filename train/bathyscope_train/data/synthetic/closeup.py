"""Mucosa close to the lens: flat to gently curved, with little relief, seen straight or at a slant."""

import numpy as np

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.noise import periodic_noise
from bathyscope_train.data.synthetic.scene import FIELD, Scene, Stage, make_surface, smooth_field
from bathyscope_train.data.synthetic.tissue import blend, make_tissue, palette, without_streaks

_SAMPLES = 400


def closeup(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """A bowl, saddle or dome, at times with a shallow fold, a lesion or a depression."""
    extent = random.uniform(50.0, 110.0)
    step = extent / _SAMPLES
    axis = (np.arange(_SAMPLES, dtype=np.float32) + 0.5) * np.float32(step) - np.float32(extent / 2)
    y, x = axis[:, None], axis[None, :]
    turn = random.uniform(0, np.pi)
    a, b = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    first, second = random.uniform(-0.6, 1.0, 2) * random.uniform(0.0, 1.0) / extent
    ground = 0.55 * extent
    waves = periodic_noise(random, (_SAMPLES, _SAMPLES), (step, step), grain_mm=extent / 7)
    heights = ground - first * a**2 - second * b**2 + random.uniform(0.0, 0.012) * extent * waves
    share = np.clip(0.4 + 0.3 * waves, 0, 1)
    for _ in range(int(random.integers(0, 5))):
        centre, size = random.uniform(-0.3, 0.3, 2) * extent, random.uniform(0.02, 0.09) * extent
        stretch = random.uniform(0.5, 1.0)
        inside = np.clip(1.0 - ((a - centre[0]) / size) ** 2 - ((b - centre[1]) * stretch / size) ** 2, 0.0, 1.0)
        heights -= random.uniform(-0.25, 0.5) * size * inside ** random.uniform(0.6, 2.0)
        share = np.clip(share + random.uniform(-0.5, 0.8) * inside, 0, 1)
    for _ in range(int(random.integers(0, 4))):
        bend = random.uniform(0.0, 0.12) * extent * np.sin(2 * np.pi * b / random.uniform(30.0, 90.0))
        width = random.uniform(0.015, 0.05) * extent
        fold = np.exp(-(((a - random.uniform(-0.35, 0.35) * extent - bend) / width) ** 2))
        heights -= random.uniform(0.3, 1.3) * width * fold
    rim = np.clip((np.hypot(x, y) / extent - 0.36) / 0.14, 0.0, None)
    heights = np.asarray(heights - 0.6 * extent * rim**2, np.float32)
    heights = smooth_field(heights, 1.5)
    tint = material.variety[0] + (material.variety[1] - material.variety[0]) * random.uniform()
    albedo = blend(palette(random, material), palette(random, material), np.asarray(tint * share, np.float32))
    surface = make_surface(
        FIELD,
        heights,
        first=(float(axis[0]), float(axis[0])),
        step=(step, step),
        stride_mm=0.02 * extent,
        feature_mm=0.03 * extent,
    )
    grain = random.uniform(0.35, 1.0)
    tissue = make_tissue(
        random, material, albedo, (extent, extent), wrap=False, vessel_step_mm=0.0022 * extent, grain=grain
    )
    target = (0.0, 0.0, float(heights[_SAMPLES // 2, _SAMPLES // 2]))
    spread = (0.12 * extent, 0.12 * extent, 0.0)
    stage = Stage(target, spread, (0.09 * extent, 0.34 * extent), (0.0, 58.0), margin_mm=0.03 * extent)
    return Scene("closeup", surface, without_streaks(tissue, albedo, surface), stage=stage)

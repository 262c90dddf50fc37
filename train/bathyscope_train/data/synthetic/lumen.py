"""Bent tubes: a colon with folds and polyps, and a narrow nasal passage with bulging walls."""

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.noise import periodic_noise
from bathyscope_train.data.synthetic.passage import passage
from bathyscope_train.data.synthetic.scene import TUBE, Scene, make_surface
from bathyscope_train.data.synthetic.tissue import blend, make_tissue, palette

Array = npt.NDArray[np.float32]

_COLUMNS = 256


def diamond_angles(columns: int) -> Array:
    """Angle of each column of a radius map.

    Columns are even in the diamond angle (y / (|x| + |y|) and its continuation), which costs the ray
    marcher one division where the true angle costs an arc tangent.
    """
    quarter, rest = np.divmod(np.arange(columns) * 4.0 / columns, 1.0)
    return np.asarray(quarter * np.pi / 2 + np.arctan2(rest, 1.0 - rest), np.float32)


def centreline(random: np.random.Generator, z: Array, bend: float, wavelengths: tuple[float, float]) -> Array:
    """A centreline, x and y along z, ``(rows, 2)``: three waves a direction, slope at most about ``bend``."""
    line = np.zeros((len(z), 2))
    for axis in range(2):
        for _ in range(3):
            wave = 2 * np.pi / random.uniform(*wavelengths)
            phase = random.uniform(0, 2 * np.pi)
            line[:, axis] += random.uniform(0, bend / 2) / wave * (np.sin(wave * z + phase) - np.sin(phase))
    return np.asarray(line, np.float32)


def _taper(z: Array, cap_mm: float) -> Array:
    """Round ends: 1 along the tube, 0 at both ends, ``(rows, 1)``."""
    inside = np.minimum(z - z[0], z[-1] - z) / cap_mm
    return np.asarray(np.sqrt(1.0 - np.clip(1.0 - inside, 0.0, 1.0) ** 2), np.float32)[:, None]


def _angular(theta: Array, centre: float) -> Array:
    """Signed difference to ``centre``, in (-pi, pi]."""
    return np.asarray((theta - centre + np.pi) % (2 * np.pi) - np.pi, np.float32)


def _smooth(heights: npt.NDArray[np.floating], samples: float) -> Array:
    """Blur a radius map, round its ring too, so that no step is steeper than the map resolves."""
    edge = 8
    padded = cv2.copyMakeBorder(heights, 0, 0, edge, edge, cv2.BORDER_WRAP)
    return np.asarray(
        cv2.GaussianBlur(padded, (0, 0), samples, borderType=cv2.BORDER_REPLICATE)[:, edge:-edge], np.float32
    )


def colon(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """A colon-like lumen: rounded or three-cornered, with partial ring folds and up to five polyps."""
    radius = random.uniform(11.0, 22.0)
    z = np.arange(-35.0, random.uniform(120.0, 190.0), 0.4, dtype=np.float32)
    theta = diamond_angles(_COLUMNS)
    step = (0.4, 2 * np.pi * radius / _COLUMNS)
    rough = periodic_noise(random, (len(z), _COLUMNS), step, grain_mm=22.0)
    lobes, corner = random.integers(2, 4), random.uniform(0, 2 * np.pi)
    twist = random.uniform(-0.01, 0.01)
    heights = 1 + 0.06 * rough + random.uniform(0, 0.13) * np.cos(lobes * (theta + corner + twist * z[:, None]))

    base, redder = palette(random, material), palette(random, material) * np.array([1.0, 0.75, 0.7], np.float32)
    patches = periodic_noise(random, (len(z), _COLUMNS), step, grain_mm=14.0)
    tint = material.variety[0] + (material.variety[1] - material.variety[0]) * random.uniform()
    share = np.clip(0.5 + 0.5 * patches, 0, 1) * tint
    folds, crest = _folds(random, z, theta)
    heights -= folds
    share -= 0.5 * tint * crest
    heights *= radius
    for _ in range(int(random.integers(0, 6))):
        bump, cover = _polyp(random, z, theta, radius)
        heights -= bump
        share = share + 0.8 * cover
    heights = np.maximum(_smooth(heights, 0.7), 0.3 * radius) * _taper(z, 18.0)
    surface = make_surface(
        TUBE,
        heights,
        centre=centreline(random, z, random.uniform(0.1, 0.9), (90.0, 260.0)),
        first=(float(z[0]), 0.0),
        step=(0.4, 4.0 / _COLUMNS),
        stride_mm=1.6,
        feature_mm=4.0,
    )
    size_mm = (float(z[-1] - z[0]), 2 * np.pi * radius)
    albedo = blend(base, redder, np.clip(share, 0, 1))
    return Scene("lumen", surface, make_tissue(random, material, albedo, size_mm, wrap=True))


def _folds(random: np.random.Generator, z: Array, theta: Array) -> tuple[Array, Array]:
    """Depth of the folds as a share of the radius, and where their crests are, each ``(rows, columns)``."""
    depth = np.zeros((len(z), len(theta)), np.float32)
    strength = random.uniform(0.6, 1.1)
    spacing = random.uniform(11.0, 26.0)
    at = float(z[0]) + random.uniform(5, 20)
    around = random.integers(2, 4)
    while at < z[-1]:
        middle = at + random.uniform(0.5, 3.0) * np.cos(theta - random.uniform(0, 2 * np.pi))
        extent = np.clip(
            random.uniform(0.3, 0.8) + 0.6 * np.cos(around * (theta - random.uniform(0, 2 * np.pi))), 0.0, 1.0
        )
        height = strength * random.uniform(0.14, 0.42) * extent * extent * (3 - 2 * extent)
        width = random.uniform(1.3, 3.6)
        rows = np.abs(z - at) < 5 * width + 4
        profile = np.exp(-(np.abs((z[rows, None] - middle) / width) ** 2.2))
        depth[rows] = np.maximum(depth[rows], height * profile)
        at += spacing * random.uniform(0.6, 1.5)
    return depth, np.clip(depth / 0.3, 0.0, 1.0)


def _polyp(random: np.random.Generator, z: Array, theta: Array, radius: float) -> tuple[Array, Array]:
    """Height in millimetres of one round polyp, and the area that it covers."""
    size = random.uniform(2.0, 6.5)
    height = random.uniform(0.6, 1.05) * size
    along = (z - random.uniform(10.0, z[-1] - 10.0))[:, None] / size
    across = _angular(theta, random.uniform(0, 2 * np.pi)) * (radius - 0.6 * height) / size
    inside = np.clip(1.0 - along**2 - across**2, 0.0, 1.0)
    return np.asarray(height * inside**0.45, np.float32), np.asarray(np.clip(3 * inside, 0, 1), np.float32)


def sinus(random: np.random.Generator, material: MaterialRanges) -> Scene:
    """A nose: a narrow tube, higher than wide, with long rounded ridges, or, twice as often, an open passage."""
    if random.uniform() < 0.67:
        return passage(random, material)
    radius = random.uniform(6.0, 11.0)
    z = np.arange(-15.0, random.uniform(45.0, 80.0), 0.2, dtype=np.float32)
    theta = diamond_angles(_COLUMNS)
    step = (0.2, 2 * np.pi * radius / _COLUMNS)
    stretch, upright = random.uniform(0.15, 0.4), random.uniform(0, np.pi)
    rough = periodic_noise(random, (len(z), _COLUMNS), step, grain_mm=9.0)
    heights = radius * (1 + stretch * np.cos(2 * (theta - upright)) + 0.06 * rough)
    base, other = palette(random, material), palette(random, material)
    share = np.zeros(heights.shape, np.float32) + 0.15 * np.clip(rough, 0, 1)
    for _ in range(int(random.integers(2, 6))):
        length, breadth = random.uniform(6.0, 22.0), random.uniform(0.45, 1.0)
        along = (z - random.uniform(0.0, z[-1] - 5.0))[:, None] / length
        swing = random.uniform(-0.5, 0.5)
        across = _angular(theta, random.uniform(0, 2 * np.pi)) / breadth + swing * along
        ridge = np.sin(np.pi / 2 * np.clip(1.0 - along**2 - across**2, 0.0, 1.0)) ** 0.85
        heights = np.minimum(heights, heights * (1.0 - random.uniform(0.25, 0.6) * ridge))
        share = np.maximum(share, random.uniform(0.2, 1.0) * np.clip(2 * ridge, 0, 1))
    heights = np.maximum(_smooth(heights, 2.5), 0.34 * radius) * _taper(z, 8.0)
    surface = make_surface(
        TUBE,
        heights,
        centre=centreline(random, z, random.uniform(0.1, 0.6), (40.0, 120.0)),
        first=(float(z[0]), 0.0),
        step=(0.2, 4.0 / _COLUMNS),
        stride_mm=0.8,
        feature_mm=2.0,
    )
    size_mm = (float(z[-1] - z[0]), 2 * np.pi * radius)
    albedo = blend(base, other, np.clip(share, 0, 1))
    tissue = make_tissue(random, material, albedo, size_mm, wrap=True, vessel_step_mm=0.12, grain=0.6)
    return Scene("sinus", surface, tissue)

"""What lies on tissue or is painted on it, drawn into its colour and gloss maps; all sizes in millimetres.

Bands, round and along a tube, are there to be bright or dark at any depth.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges, draw
from bathyscope_train.data.synthetic.noise import periodic_noise

Array = npt.NDArray[np.float32]

_BLOOD = np.array([0.26, 0.022, 0.014], np.float32)
_MUCUS = np.array([0.85, 0.76, 0.5], np.float32)


class Coating(NamedTuple):
    """The two maps of a surface, on its own grid."""

    albedo: Array
    """``(rows, columns, 3)``, linear."""
    gloss: Array
    """``(rows, columns)``: strength of highlights against the plain tissue."""


class Patch(NamedTuple):
    """The lie of a surface map."""

    size_mm: tuple[float, float]
    wrap: bool
    """Whether its columns close to a ring."""


def coat_surface(random: np.random.Generator, material: MaterialRanges, albedo: Array, patch: Patch) -> Coating:
    """Draw everything that the ranges ask for onto a surface; with nothing asked for the albedo stays as it is.

    Args:
        random: Source; each kind of film has a stream of its own.
        material: Ranges.
        albedo: ``(rows, columns, 3)``.
        patch: Size of the map.
    """
    rings, blood, mucus, foam = random.spawn(4)
    coating = Coating(albedo, np.ones(albedo.shape[:2], np.float32))
    if rings.uniform() < material.banded:
        painted = albedo * _bands(rings, albedo, patch)[..., None]
        coating = coating._replace(albedo=painted / np.float32(max(1.0, float(painted.max()))))
    if blood.uniform() < material.bloody:
        colour, steep = _BLOOD * np.float32(blood.uniform(0.5, 1.6)), blood.uniform(2.0, 10.0)
        coating = _pool(blood, coating, patch, colour, opacity=(0.5, 0.95), steep=steep)
    if mucus.uniform() < material.slimy:
        colour, steep = _MUCUS * np.float32(mucus.uniform(0.7, 1.1)), mucus.uniform(0.6, 3.0)
        coating = _pool(mucus, coating, patch, colour, opacity=(0.1, 0.5), steep=steep)
    if foam.uniform() < material.foamy:
        coating = _bubbles(foam, coating, patch)
    return coating


def _noise(random: np.random.Generator, albedo: Array, patch: Patch, grain_mm: float) -> Array:
    rows, columns = albedo.shape[:2]
    return periodic_noise(random, (rows, columns), (patch.size_mm[0] / rows, patch.size_mm[1] / columns), grain_mm)


def _bands(random: np.random.Generator, albedo: Array, patch: Patch) -> Array:
    """Factor of one to five bands, across the map's rows or columns, their edges soft and uneven."""
    along = int(random.uniform() < 0.35)
    length = patch.size_mm[along]
    places = (np.arange(albedo.shape[along], dtype=np.float32) + 0.5) * np.float32(length / albedo.shape[along])
    places = places[:, None] if along == 0 else places[None, :]
    uneven = np.float32(random.uniform(0.2, 3.0)) * _noise(random, albedo, patch, random.uniform(6.0, 25.0))
    factor = np.ones(albedo.shape[:2], np.float32)
    for _ in range(int(random.integers(1, 6))):
        away = places - np.float32(random.uniform(0.0, length)) + uneven
        if along == 1 and patch.wrap:
            away = (away + np.float32(length / 2)) % np.float32(length) - np.float32(length / 2)
        half, edge = random.uniform(1.0, 9.0), random.uniform(0.2, 2.5)
        share = np.clip((half - np.abs(away)) / edge + 0.5, 0.0, 1.0)
        factor *= np.float32(random.choice([0.25, 0.4, 0.6, 1.5, 2.0])) ** share
    return factor


def _pool(
    random: np.random.Generator,
    coating: Coating,
    patch: Patch,
    colour: Array,
    *,
    opacity: tuple[float, float],
    steep: float,
) -> Coating:
    """Puddles and smears of a liquid: opaque or thin, glossy; ``steep`` is the opacity gained a grain from the rim."""
    noise = _noise(random, coating.albedo, patch, random.uniform(3.0, 14.0))
    level = float(np.quantile(noise, random.uniform(0.8, 0.985)))
    share = np.clip(steep * (noise - level), 0.0, 1.0) * draw(random, opacity)
    mixed = (1 - share[..., None]) * coating.albedo + share[..., None] * colour
    gloss = coating.gloss * (1 + share * draw(random, (0.5, 2.5)))
    return Coating(np.asarray(mixed, np.float32), np.asarray(gloss, np.float32))


def _bubbles(random: np.random.Generator, coating: Coating, patch: Patch) -> Coating:
    """Foam: clusters of bubbles, each a bright rim, a brighter inside and a glint."""
    albedo, gloss = coating.albedo.copy(), coating.gloss.copy()
    rows, columns = gloss.shape
    step = np.array([patch.size_mm[0] / rows, patch.size_mm[1] / columns])
    for _ in range(int(random.integers(1, 7))):
        cluster = random.uniform((0.0, 0.0), patch.size_mm)
        spread = random.uniform(2.0, 9.0)
        for _ in range(int(random.integers(2, 22))):
            centre, radius = cluster + spread * random.standard_normal(2), float(random.uniform(0.5, 2.4))
            first = np.maximum(np.floor((centre - radius) / step).astype(int), 0)
            last = np.minimum(np.ceil((centre + radius) / step).astype(int) + 1, gloss.shape)
            if (last <= first).any():
                continue
            window = (slice(first[0], last[0]), slice(first[1], last[1]))
            v = ((np.arange(first[0], last[0]) + 0.5) * step[0] - centre[0])[:, None] / radius
            u = ((np.arange(first[1], last[1]) + 0.5) * step[1] - centre[1])[None, :] / radius
            away = np.hypot(u, v)
            rim = np.exp(-(((away - 0.85) / 0.18) ** 2))
            glint = np.exp(-(((u + 0.35) ** 2 + (v + 0.35) ** 2) / 0.03))
            share = np.where(away < 1.0, np.clip(0.12 + 0.5 * rim + 0.8 * glint, 0.0, 1.0), 0.0)[..., None]
            albedo[window] = (1 - share) * albedo[window] + share
            gloss[window] = np.where(away < 1.0, 2.5, gloss[window])
    return Coating(albedo, gloss)

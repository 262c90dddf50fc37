"""Colour and relief of the tissue of one scene."""

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges, draw
from bathyscope_train.data.synthetic.films import Patch, coat_surface
from bathyscope_train.data.synthetic.noise import gradient_noise, periodic_noise
from bathyscope_train.data.synthetic.scene import Surface, Tissue
from bathyscope_train.data.synthetic.vessels import vessel_map

Array = npt.NDArray[np.float32]

_SOLID = 56
_SOLID_STEP_MM = 0.4
_STEEP = 2.0  # slope at which half of the vessels are left


def palette(random: np.random.Generator, material: MaterialRanges) -> Array:
    """A linear tissue colour with red >= green >= blue, ``(3,)``."""
    red = draw(random, material.red)
    green = red * draw(random, material.green_over_red)
    return np.array([red, green, green * draw(random, material.blue_over_green)], np.float32)


def settle_palette(random: np.random.Generator, material: MaterialRanges) -> MaterialRanges:
    """The ranges of one scene: those of the palette that it gets, if there is a choice."""
    which = int(random.spawn(1)[0].integers(len(material.palettes) + 1))
    if which == 0:
        return material
    return material.model_copy(update=dict(material.palettes[which - 1]))


def blend(base: Array, other: Array, share: Array | float) -> Array:
    """Mix two colours geometrically, which keeps red >= green >= blue where both have it."""
    weight = np.asarray(share, np.float32)[..., None]
    return np.asarray(np.exp((1 - weight) * np.log(base) + weight * np.log(other)), np.float32)


def solid_grain(random: np.random.Generator) -> Array:
    """Blotches, spots and relief slopes in a block that repeats, ``(n, n, n, 5)``."""
    shape, step = (_SOLID,) * 3, (_SOLID_STEP_MM,) * 3
    blotches = periodic_noise(random, shape, step, grain_mm=5.0, slope=3.0)
    spots = np.clip(periodic_noise(random, shape, step, grain_mm=1.2) - 1.3, 0.0, 1.0)
    relief = gradient_noise(random, shape, step, grain_mm=1.6)
    return np.ascontiguousarray(np.concatenate([blotches[..., None], spots[..., None], relief], axis=-1))


def make_tissue(
    random: np.random.Generator,
    material: MaterialRanges,
    albedo: Array,
    size_mm: tuple[float, float],
    *,
    wrap: bool,
    vessel_step_mm: float = 0.22,
    grain: float = 1.0,
) -> Tissue:
    """Draw a material for a surface whose large-scale colours are known.

    Args:
        random: Source of every choice.
        material: Ranges to draw from.
        albedo: Colours on the surface's grid.
        size_mm: Mean height and width of the surface map.
        wrap: Whether its columns close to a ring.
        vessel_step_mm: Resolution of the vessels.
        grain: Size of blotches, relief and vessels against their usual size.
    """
    films, wetness = random.spawn(2)
    coating = coat_surface(films, material, albedo, Patch(size_mm, wrap))
    area = size_mm[0] * size_mm[1] / 20_000.0
    trees = max(1, round(draw(random, material.vessels) * area)) if material.vessels[1] > 0 else 0
    level = vessel_map(random, size_mm, vessel_step_mm, trees, wrap=wrap, width=grain)
    levels = [level]
    for _ in range(3):
        rows, columns = (max(2, n // 2) for n in levels[-1].shape)
        levels.append(np.ascontiguousarray(cv2.resize(levels[-1], (columns, rows), interpolation=cv2.INTER_AREA)))
    contrast = draw(random, material.vessel_contrast)
    return Tissue(
        albedo=np.ascontiguousarray(coating.albedo),
        vessels=(levels[0], levels[1], levels[2], levels[3]),
        vessel_step_mm=vessel_step_mm,
        vessel_tint=(1.0 - 0.35 * contrast, 1.0 - contrast, 1.0 - 0.95 * contrast),
        solid=solid_grain(random),
        solid_step_mm=_SOLID_STEP_MM * grain,
        mottle=draw(random, material.mottle),
        spots=draw(random, material.spots),
        bump=draw(random, material.bump),
        specular=draw(random, material.specular),
        shininess=draw(random, material.shininess),
        gloss=coating.gloss,
        coat=draw(wetness, material.coat) if wetness.uniform() < material.coated else 0.0,
        coat_shininess=draw(wetness, material.coat_shininess),
        coat_bump=draw(wetness, material.coat_bump),
        dry=draw(wetness, material.dry),
        regions=draw(wetness, material.regions),
        region_edge=draw(wetness, material.region_edge),
        region_level=float(wetness.uniform(-0.7, 0.7)),
        fine=draw(wetness, material.fine),
        capillaries=draw(wetness, material.capillaries),
    )


def without_streaks(tissue: Tissue, bare: Array, surface: Surface) -> Tissue:
    """The tissue of a field with vessels and films faded on steep walls, where their map would stretch them.

    Args:
        tissue: What ``make_tissue`` gave.
        bare: Colours without films, ``(rows, columns, 3)``.
        surface: The field.
    """
    slope = np.hypot(*np.gradient(surface.heights, *surface.step))
    keep = np.asarray(1.0 / (1.0 + (slope / _STEEP) ** 4), np.float32)
    levels = [
        np.ascontiguousarray(level * cv2.resize(keep, level.shape[::-1], interpolation=cv2.INTER_AREA))
        for level in tissue.vessels
    ]
    even = tissue.gloss.shape != keep.shape
    return tissue._replace(
        albedo=np.ascontiguousarray(bare + keep[..., None] * (tissue.albedo - bare)),
        vessels=(levels[0], levels[1], levels[2], levels[3]),
        gloss=tissue.gloss if even else np.ascontiguousarray(1.0 + keep * (tissue.gloss - 1.0), np.float32),
    )

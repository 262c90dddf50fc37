"""Shading in torch: what ``shading`` does a point at a time, for the points ``(3, s, n)`` of s rows at once."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.synthetic.scene import TUBE
from bathyscope_train.data.synthetic.shading import (
    _LEAST as LEAST_VISIBLE,
)
from bathyscope_train.data.synthetic.shading import (
    BROADER,
    CAPILLARY,
    CREST,
    FINER,
    LARGER,
    SHEEN,
    STRAY,
)
from bathyscope_train.data.synthetic.torch_layout import Atlas
from bathyscope_train.data.synthetic.torch_scene import CameraTensors, LampTensors, SurfaceTensors, TissueTensors
from bathyscope_train.data.synthetic.torch_tracing import Points, Values, at_rest, free_depth, normal, place


class View(NamedTuple):
    """Where rays end and how far they came."""

    points: Points
    distance: Values
    """Along the ray."""
    footprint: Values
    """Size of a pixel at the point."""
    to_camera: Points
    """Unit vectors."""


class Grain(NamedTuple):
    """The tissue's texture at points."""

    blotches: Values
    spots: Values
    relief: Points
    """Slope."""
    fine: Values
    """How far the relief is resolved."""
    capillaries: Values | float


class Film(NamedTuple):
    """Wet film over the tissue."""

    strength: Values
    normals: Points


def shade(
    surface: SurfaceTensors, tissue: TissueTensors, lamp: LampTensors, camera: CameraTensors, view: View
) -> tuple[Points, Values]:
    """Radiance of surface points, and how much of it is highlight."""
    points, footprint = view.points, view.footprint
    smooth = normal(surface, points, torch.maximum(1.5 * surface.row_step, 0.4 * footprint))
    rest = at_rest(surface, points)  # its texture goes with the tissue
    grain = _octaves(tissue, rest, footprint)
    colour, gloss = _colour(surface, tissue, view, rest, grain)

    # The relief tilts the normal only as far as a pixel resolves it; the rest widens the highlight.
    tilted = _tilt(smooth, grain.relief, tissue.bump * grain.fine)
    lost = tissue.bump * (1 - grain.fine)
    shininess = tissue.shininess / (1 + tissue.shininess * lost * lost)
    film = _film(tissue, rest, smooth, grain) if tissue.coated else None

    h = surface.feature_mm
    open_space = CREST + (1 - CREST) * (1.25 * free_depth(surface, points + h * smooth) / h).clamp(0, 1)
    direct, highlight, sheen = (torch.zeros_like(view.distance) for _ in range(3))
    for to_lamp, power in lamp_light(lamp, camera, points):
        facing = ((0.7 * tilted + 0.3 * smooth) * to_lamp).sum(0)
        direct += power * ((facing + 0.15) / 1.15).clamp_min(0)
        middle = to_lamp + view.to_camera
        middle = middle / (middle.square().sum(0).sqrt() + 1e-12)
        gain = (shininess + 2) / (tissue.shininess + 2)
        highlight += power * gain * _sheen((tilted * middle).sum(0), shininess)
        if film is not None:
            sheen += power * _sheen((film.normals * middle).sum(0), tissue.coat_shininess)
    scattered = lamp.ambient * (20 / (view.distance + 5))
    highlight = highlight * (7 * tissue.specular)
    highlight = gloss * (highlight if film is None else highlight + film.strength * sheen)
    warm = colour.new_tensor([1.3, 1.0, 1.0])[:, None, None]
    return colour * open_space * (direct + scattered * warm * colour) + highlight, highlight


def lamp_light(lamp: LampTensors, camera: CameraTensors, points: Points) -> Iterator[tuple[Points, Values]]:
    """Of each light guide the unit vectors from points to it, and the light that arrives."""
    beam = (camera.turn * lamp.axis).sum(1)
    for offset, lit in zip(lamp.offsets, lamp.lit, strict=True):
        arm = (camera.turn * offset).sum(1) + camera.position - points
        reach = arm.square().sum(0).sqrt()
        to_lamp = arm / reach
        axis = (-(beam * to_lamp).sum(0)).clamp_min(0)
        power = lit * axis**lamp.spot * (20 / torch.sqrt(reach * reach + lamp.soft_mm**2)) ** lamp.falloff
        s = ((axis - lamp.cone[1]) / (lamp.cone[0] - lamp.cone[1])).clamp(0, 1)
        edge = STRAY + (1 - STRAY) * s * s * (3 - 2 * s)
        yield to_lamp, torch.where(lamp.cone[1] >= -1, power * edge, power)


def _sheen(cosine: Values, shininess: Values) -> Values:
    """A highlight; nothing far from the mirrored ray."""
    return torch.where(cosine > SHEEN, cosine.clamp_min(SHEEN) ** (10 * shininess), 0.0)


def _tilt(normals: Points, relief: Points, slope: Values) -> Points:
    tilted = normals - slope * relief
    return tilted / tilted.square().sum(0).sqrt()


def _film(tissue: TissueTensors, points: Points, smooth: Points, grain: Grain) -> Film:
    """Smoother than the relief, broken where the tissue is dry, with small sharp highlights."""
    x, y, z = points * (BROADER / tissue.solid_step_mm)
    broad = _look_up(tissue.solid, torch.stack([y, z, x]))
    normals = _tilt(smooth, 0.35 * grain.fine * grain.relief + broad[2:5], tissue.coat_bump)
    return Film(7 * tissue.coat * (2 * (broad[0] - tissue.dry) + 0.5).clamp(0, 1), normals)


def _octaves(tissue: TissueTensors, points: Points, footprint: Values) -> Grain:
    """Three octaves of the same block, each read in another direction."""
    x, y, z = points / tissue.solid_step_mm
    coarse = _look_up(tissue.solid, 0.27 * torch.stack([z, x, -y]))[0]
    own = _look_up(tissue.solid, torch.stack([x, y, z]))
    fine = 1 / (1 + (footprint / (3 * tissue.solid_step_mm)).square())
    grain = Grain(0.5 * own[0] * fine + 0.8 * coarse, own[1] * fine, own[2:5], fine, 0.0)
    if not tissue.finer:
        return grain
    third = _look_up(tissue.solid, FINER * torch.stack([y, z, x]))
    visible = 1 / (1 + (footprint * FINER / tissue.solid_step_mm / 3).square())
    visible = torch.where(visible < LEAST_VISIBLE, 0.0, visible)
    share = tissue.fine * visible
    lines = torch.exp(-(third[0] / CAPILLARY).square())
    return grain._replace(
        blotches=grain.blotches + 0.5 * share * third[0],
        relief=grain.relief + share * third[2:5],
        capillaries=tissue.capillaries * visible * lines * (0.5 + coarse).clamp(0, 1),
    )


def _regions(tissue: TissueTensors, points: Points) -> Values:
    """Share of the colour that light and dark regions leave: 1 in the light ones, ``e^-regions`` in the dark."""
    x, y, z = points * (LARGER / tissue.solid_step_mm)
    level = _look_up(tissue.solid, torch.stack([x, -z, y]))[0]
    side = (tissue.region_edge * (level - tissue.region_level)).clamp(-1, 1)
    return torch.exp(0.5 * tissue.regions * (side - 1))


def _look_up(solid: Atlas, points: Points) -> Float[Tensor, "5 s n"]:
    """Trilinear look-up in the repeating block; coordinates in samples."""
    n = solid.columns
    corner = points.floor()
    weight = (points - corner)[..., None]
    low = corner.long() % n
    high = (low + 1) % n

    def line(i: Tensor, j: Tensor) -> Tensor:
        return torch.lerp(solid.at(i * n + j, low[2]), solid.at(i * n + j, high[2]), weight[2])

    front = torch.lerp(line(low[0], low[1]), line(low[0], high[1]), weight[1])
    back = torch.lerp(line(high[0], low[1]), line(high[0], high[1]), weight[1])
    return torch.lerp(front, back, weight[0]).permute(2, 0, 1)


def _vessel(tissue: TissueTensors, row: Values, column: Values, footprint: Values, wrap: bool) -> Values:
    """Vessel density at places given as shares of the map, from the level that fits the footprint."""
    size = tissue.vessel_step_mm * 1.5
    density = _bilinear(tissue.vessels[0], row, column, wrap)
    for level in tissue.vessels[1:]:
        density = torch.where(footprint > size, _bilinear(level, row, column, wrap), density)
        size = 2 * size
    return density


def _bilinear(level: Atlas, row: Values, column: Values, wrap: bool) -> Values:
    u = torch.minimum((row * level.rows - 0.5).clamp_min(0), level.rows - 1.001)
    v = column * level.columns - 0.5
    i, j = u.long(), v.floor().long()
    s = u - i
    if wrap:
        t = v - j
        j = j % level.columns
        k = (j + 1) % level.columns
    else:
        j = torch.minimum(j.clamp_min(0), level.columns - 2)
        t = v - v.floor()
        k = j + 1
    above = torch.lerp(level.at(i, j)[..., 0], level.at(i, k)[..., 0], t)
    below = torch.lerp(level.at(i + 1, j)[..., 0], level.at(i + 1, k)[..., 0], t)
    return torch.lerp(above, below, s)


def _colour(
    surface: SurfaceTensors, tissue: TissueTensors, view: View, rest: Points, grain: Grain
) -> tuple[Points, Values]:
    """Reflectance at points of the surface, and their gloss against the rest of the tissue."""
    row, column, _ = place(surface, view.points)
    wrap = surface.kind == TUBE
    i = torch.minimum((row + 0.5).long().clamp_min(0), surface.rows - 1)
    j = (column + 0.5).long()
    j = j % surface.columns if wrap else torch.minimum(j.clamp_min(0), surface.columns - 1)
    share = (row + 0.5) / surface.rows, (column + 0.5) / surface.columns
    vessel = _vessel(tissue, *share, view.footprint, wrap)
    vessel = vessel + grain.capillaries * (1 - vessel)
    deep = view.points.new_tensor([1.0, 1.5, 2.0])[:, None, None]  # blotches are blood: blue changes most
    value = tissue.albedo.at(i, j).permute(2, 0, 1) * (1 - vessel * (1 - tissue.vessel_tint))
    value = value * _regions(tissue, rest) if tissue.varied else value
    value = value * (1 + tissue.mottle * grain.blotches * deep).clamp_min(0.2)
    gloss = tissue.gloss.at(torch.minimum(i, tissue.gloss.rows - 1), torch.minimum(j, tissue.gloss.columns - 1))
    return value * (1 - tissue.spots * grain.spots * deep).clamp_min(0.15), gloss[..., 0]

"""Shading in torch: what ``shading`` does a point at a time, for the points ``(3, s, n)`` of s scenes at once."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.scene import TUBE
from bathyscope_train.data.synthetic.shading import CREST, SHEEN
from bathyscope_train.data.synthetic.torch_compaction import pick
from bathyscope_train.data.synthetic.torch_scene import Atlas, SceneTensors, TissueTensors
from bathyscope_train.data.synthetic.torch_tracing import Points, Values, free_depth, normal, place


class View(NamedTuple):
    """Where rays end and how they came there."""

    points: Points
    origin: Points
    frame: Int[Tensor, "s n"]
    """The ray's frame."""
    distance: Values
    """Along the ray."""
    footprint: Values
    """Size of a pixel at the point."""


def shade(scene: SceneTensors, view: View) -> tuple[Points, Values]:
    """Radiance of surface points, and how much of it is highlight."""
    surface, tissue = scene.surface, scene.tissue
    points, distance, footprint = view.points, view.distance, view.footprint
    smooth = normal(surface, points, torch.maximum(1.5 * surface.row_step, 0.4 * footprint))
    place_in_grain = points / tissue.solid_step_mm
    x, y, z = 0.27 * place_in_grain
    coarse = _grain(tissue.solid, torch.stack([z, x, -y]))[..., 0]
    grain = _grain(tissue.solid, place_in_grain).unbind(-1)
    fine = 1 / (1 + (footprint / (3 * tissue.solid_step_mm)).square())
    blotches, spots = 0.5 * grain[0] * fine + 0.8 * coarse, grain[1] * fine
    colour = _colour(scene, view, blotches, spots)

    # The relief tilts the normal only as far as a pixel resolves it; the rest widens the highlight.
    tilted = smooth - tissue.bump * fine * torch.stack(grain[2:5])
    tilted = tilted / tilted.square().sum(0).sqrt()
    lost = tissue.bump * (1 - fine)
    shininess = tissue.shininess / (1 + tissue.shininess * lost * lost)

    h = surface.feature_mm
    open_space = CREST + (1 - CREST) * (1.25 * free_depth(surface, points + h * smooth) / h).clamp(0, 1)
    direct, highlight = _light(scene, view, smooth, tilted, shininess)
    scattered = scene.lamp.ambient * (20 / (distance + 5))
    highlight = highlight * (7 * tissue.specular)
    warm = colour.new_tensor([1.3, 1.0, 1.0])[:, None, None]
    return colour * open_space * (direct + scattered * warm * colour) + highlight, highlight


def _light(scene: SceneTensors, view: View, smooth: Points, tilted: Points, shininess: Values) -> tuple[Values, Values]:
    """Light that falls on points from the lamps, and what they mirror of it."""
    lamp, tissue = scene.lamp, scene.tissue
    to_camera = (view.origin - view.points) / view.distance
    beam = pick(scene.scene_from_camera[:, :, :3, 2].permute(2, 0, 1), view.frame)
    direct, highlight = torch.zeros_like(view.distance), torch.zeros_like(view.distance)
    for index in range(lamp.offsets.shape[1]):
        turned = torch.einsum("stij,sj->ist", scene.scene_from_camera[:, :, :3, :3], lamp.offsets[:, index])
        arm = pick(turned, view.frame) + view.origin - view.points
        reach = arm.square().sum(0).sqrt()
        to_lamp = arm / reach
        axis = (-(beam * to_lamp).sum(0)).clamp_min(0)
        power = axis**lamp.spot * (20 / torch.sqrt(reach * reach + lamp.soft_mm**2)) ** lamp.falloff
        power = power * lamp.lit[:, index : index + 1]
        facing = ((0.7 * tilted + 0.3 * smooth) * to_lamp).sum(0)
        direct += power * ((facing + 0.15) / 1.15).clamp_min(0)
        middle = to_lamp + to_camera
        half = (tilted * middle).sum(0) / (middle.square().sum(0).sqrt() + 1e-12)
        sheen = half.clamp_min(SHEEN) ** (10 * shininess) * (shininess + 2) / (tissue.shininess + 2)
        highlight += torch.where(half > SHEEN, power * sheen, 0.0)
    return direct, highlight


def _grain(solid: Atlas, points: Points) -> Float[Tensor, "s n c"]:
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
    return torch.lerp(front, back, weight[0])


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
    s, t = u - i, v - j
    if wrap:
        j = j % level.columns
        k = (j + 1) % level.columns
    else:
        j = torch.minimum(j.clamp_min(0), level.columns - 2)
        k = j + 1
    above = torch.lerp(level.at(i, j)[..., 0], level.at(i, k)[..., 0], t)
    below = torch.lerp(level.at(i + 1, j)[..., 0], level.at(i + 1, k)[..., 0], t)
    return torch.lerp(above, below, s)


def _colour(scene: SceneTensors, view: View, blotches: Values, spots: Values) -> Points:
    """Reflectance at points of the surface."""
    surface, tissue, points, footprint = scene.surface, scene.tissue, view.points, view.footprint
    row, column, _ = place(surface, points)
    wrap = surface.kind == TUBE
    i = torch.minimum((row + 0.5).long().clamp_min(0), surface.rows - 1)
    j = (column + 0.5).long()
    j = j % surface.columns if wrap else torch.minimum(j.clamp_min(0), surface.columns - 1)
    vessel = _vessel(tissue, (row + 0.5) / surface.rows, (column + 0.5) / surface.columns, footprint, wrap)
    tint = tissue.vessel_tint.permute(2, 0, 1)
    deep = points.new_tensor([1.0, 1.5, 2.0])[:, None, None]  # blotches are blood: blue changes most
    value = tissue.albedo.at(i, j).permute(2, 0, 1) * (1 - vessel * (1 - tint))
    blotched = (1 + tissue.mottle * blotches * deep).clamp_min(0.2)
    return value * blotched * (1 - tissue.spots * spots * deep).clamp_min(0.15)

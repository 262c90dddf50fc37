"""Render frames in torch: a ray a pixel, traced and shaded, and four where one would alias."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.kernels import NEAREST_MM, ON_SURFACE_MM
from bathyscope_train.data.synthetic.solid_tracing import NEVER
from bathyscope_train.data.synthetic.torch_layout import compiled, everything, marked, pick, put, spread
from bathyscope_train.data.synthetic.torch_lens import undistort
from bathyscope_train.data.synthetic.torch_scene import CameraTensors, SceneTensors
from bathyscope_train.data.synthetic.torch_shading import View, shade
from bathyscope_train.data.synthetic.torch_solid_shading import shade_solids
from bathyscope_train.data.synthetic.torch_solids import trace_solids
from bathyscope_train.data.synthetic.torch_tracing import Points, Values, free_depth, trace

_BRIGHT = 0.15  # highlight from which a pixel gets four rays


class Rays(NamedTuple):
    """Rays through image points (u, v), looked for from ``start`` on."""

    u: Values
    v: Values
    start: Values


class Pictures(NamedTuple):
    """Rendered rows."""

    radiance: Float[Tensor, "s 3 h w"]
    """Linear."""
    depth: Float[Tensor, "s h w"]
    """Z-depth of the ray through each pixel's centre; 0 where there is nothing."""
    mover: Int[Tensor, "s h w"]
    """0 on what stands still, k on mover k."""


class Hits(NamedTuple):
    """What rays meet."""

    depth: Values
    """Z-depth, 0 where a ray left the map."""
    radiance: Points
    highlight: Values
    """How much of the radiance it is."""
    solid: Int[Tensor, "s n"]
    """Number of the solid, -1 for tissue and nothing."""


def render_scenes(scene: SceneTensors, size: tuple[int, int]) -> Pictures:
    """Render every row.

    Colour is that of the ray through the pixel's centre, but where depth jumps, the view grazes the surface or a
    highlight sits, it is the mean of four rays a pixel.

    Args:
        scene: The rows.
        size: Height and width.
    """
    rays = _pixel_rays(scene.camera.position, size)
    if scene.surface is not None and scene.surface.compiled:  # a row of all rays: compiled for one layout only
        every = everything(rays.u.shape[0], rays.u.shape[1], rays.u.device)
        scene, rays = spread(scene, every), Rays(*spread(tuple(rays), every))
    hits = cast_rays(scene, rays)
    maps = hits.depth.view(-1, *size)
    bend = (_bend(maps, 2) + _bend(maps, 1)).view_as(hits.depth)
    rough = (hits.highlight > _BRIGHT) | (bend > 0.03 * hits.depth)
    mover = torch.zeros_like(hits.solid)
    if scene.solids is not None:
        rough = rough | _edges(hits, size)
        number = hits.solid.clamp_min(0)
        mover = torch.where(hits.solid >= 0, scene.solids.every.at(number, torch.zeros_like(number))[..., 1].long(), 0)
    rays = rays._replace(start=(0.85 * (hits.depth - bend)).clamp_min(NEAREST_MM))
    radiance = _supersampled(scene, hits.radiance, rough, rays)
    return Pictures(radiance.reshape(3, -1, *size).transpose(0, 1), maps, mover.view(-1, *size))


def _pixel_rays(like: Float[Tensor, "3 s 1"], size: tuple[int, int]) -> Rays:
    """A ray through the centre of each pixel."""
    rows, columns = (torch.arange(n, device=like.device, dtype=like.dtype) + 0.5 for n in size)
    v, u = (axis.flatten().expand(like.shape[1], -1) for axis in torch.meshgrid(rows, columns, indexing="ij"))
    return Rays(u, v, torch.full_like(u, NEAREST_MM))


def _bend(depth: Float[Tensor, "s h w"], axis: int) -> Float[Tensor, "s h w"]:
    """Absolute second difference along an axis; the border repeats."""
    padding = (1, 1, 0, 0) if axis == 2 else (0, 0, 1, 1)
    padded = F.pad(depth, padding, mode="replicate")
    count = depth.shape[axis]
    return (padded.narrow(axis, 0, count) + padded.narrow(axis, 2, count) - 2 * depth).abs()


def _edges(hits: Hits, size: tuple[int, int]) -> Bool[Tensor, "s n"]:
    """Where one solid ends, and on solids the edges of a pattern or a shadow."""
    solid, plain = hits.solid.view(-1, *size), hits.radiance.sum(0).view(-1, *size)
    other, jump = torch.zeros_like(solid, dtype=torch.bool), torch.zeros_like(plain)
    for axis in (1, 2):
        count = solid.shape[axis]
        for shift in (-1, 1):
            beside = (torch.arange(count, device=solid.device) + shift).clamp(0, count - 1)
            other |= solid.index_select(axis, beside) != solid
            jump += (plain.index_select(axis, beside) - plain).abs()
    edges: Bool[Tensor, "s n"] = (other | ((solid >= 0) & (jump > 0.25 * plain))).view_as(hits.solid)
    return edges


def _supersampled(scene: SceneTensors, radiance: Points, rough: Bool[Tensor, "s n"], rays: Rays) -> Points:
    """Radiance with the rough pixels replaced by the mean of four rays each."""
    chosen = marked(rough)
    if len(chosen.index) == 0:
        return radiance
    u, v, start = spread(tuple(rays), chosen)
    corners = [(0.5 * (k % 2) - 0.25, 0.5 * (k // 2) - 0.25) for k in range(4)]
    four = Rays(
        torch.cat([u + du for du, _ in corners], 1),
        torch.cat([v + dv for _, dv in corners], 1),
        start.repeat(1, 4),
    )
    seen = cast_rays(spread(scene, chosen.repeat(4)), four).radiance
    return put(radiance, chosen, seen.unflatten(2, (4, -1)).mean(2))


def cast_rays(scene: SceneTensors, rays: Rays) -> Hits:
    """Trace and shade rays."""
    camera = scene.camera
    plane = torch.stack([rays.u, rays.v])
    plane = (plane - camera.centre) / camera.focal
    a, b = undistort(plane, camera.distortion) if camera.bent else plane
    slant = torch.sqrt(a * a + b * b + 1)
    direction = (camera.turn[:, 0] * a + camera.turn[:, 1] * b + camera.turn[:, 2]) / slant
    tissue, distance = _meet_tissue(scene, rays.start, direction)
    hits = tissue._replace(depth=tissue.depth / slant)
    if scene.solids is None:
        return hits
    near, far = torch.full_like(slant, NEAREST_MM), torch.full_like(slant, NEVER)
    nearest, which = trace_solids(scene.solids, near, far, camera.position, direction)
    chosen = marked((which >= 0) & (nearest < distance))
    if len(chosen.index) == 0:
        return hits
    some, some_which, some_nearest, some_direction = spread((scene, which, nearest, direction), chosen)
    assert some.solids is not None
    view = _view(some.camera, some_direction, some_nearest)
    radiance, highlight = shade_solids(some.solids, some_which, some.lamp, some.camera, view)
    return Hits(
        depth=put(hits.depth, chosen, some_nearest / pick(slant, chosen)),
        radiance=put(hits.radiance, chosen, radiance),
        highlight=put(hits.highlight, chosen, highlight),
        solid=put(hits.solid, chosen, some_which),
    )


def _view(camera: CameraTensors, direction: Points, distance: Values) -> View:
    """Points along rays as the camera sees them."""
    points = camera.position + distance * direction
    to_camera = (camera.position - points) / distance
    return View(points, distance, distance / camera.focal[0], to_camera)


def _meet_tissue(scene: SceneTensors, start: Values, direction: Points) -> tuple[Hits, Values]:
    """What rays meet of the tissue, with depth along the ray, and how far they went."""
    none = torch.full_like(start, -1, dtype=torch.int64)
    if scene.surface is None or scene.tissue is None:
        nothing = torch.zeros_like(start)
        return Hits(nothing, torch.zeros_like(direction), nothing, none), torch.full_like(start, NEVER)
    distance = trace(scene.surface, start, scene.camera.position, direction)
    view = _view(scene.camera, direction, distance)
    light = compiled(shade) if scene.surface.compiled else shade
    radiance, highlight = light(scene.surface, scene.tissue, scene.lamp, scene.camera, view)
    there = free_depth(scene.surface, view.points).abs() < ON_SURFACE_MM
    return Hits(torch.where(there, distance, 0.0), radiance, highlight, none), distance

"""Render frames in torch: a ray a pixel, traced and shaded, and four where one would alias."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.kernels import NEAREST_MM, ON_SURFACE_MM
from bathyscope_train.data.synthetic.torch_compaction import compact, pick, put
from bathyscope_train.data.synthetic.torch_scene import SceneTensors
from bathyscope_train.data.synthetic.torch_shading import View, shade
from bathyscope_train.data.synthetic.torch_tracing import Points, Values, free_depth, trace

_BRIGHT = 0.15  # highlight from which a pixel gets four rays


class Rays(NamedTuple):
    """Rays through image points (u, v) of frames, looked for from ``start`` on."""

    frame: Int[Tensor, "s n"]
    u: Values
    v: Values
    start: Values


def render_scenes(
    scene: SceneTensors, size: tuple[int, int]
) -> tuple[Float[Tensor, "s t 3 h w"], Float[Tensor, "s t h w"]]:
    """Linear radiance and z-depth of every frame of every clip.

    Depth is that of the ray through the pixel's centre, 0 where it left the map. Colour is that ray's too, but where
    depth jumps, the view grazes the surface or a highlight sits, it is the mean of four rays a pixel.

    Args:
        scene: The clips.
        size: Height and width.
    """
    rays = _pixel_rays(scene, size)
    depth, radiance, highlight = cast_rays(scene, rays)
    shape = (scene.scene_from_camera.shape[1], *size)
    maps = depth.unflatten(1, shape)
    bend = (_bend(maps, 3) + _bend(maps, 2)).flatten(1)
    rough = (highlight > _BRIGHT) | (bend > 0.03 * depth)
    rays = rays._replace(start=(0.85 * (depth - bend)).clamp_min(NEAREST_MM))
    radiance = _supersampled(scene, radiance, rough, rays)
    return radiance.unflatten(2, shape).permute(1, 2, 0, 3, 4), maps


def _pixel_rays(scene: SceneTensors, size: tuple[int, int]) -> Rays:
    """A ray through the centre of each pixel of every frame."""
    like, t = scene.intrinsics, scene.scene_from_camera.shape[1]
    rows, columns = (torch.arange(n, device=like.device, dtype=like.dtype) + 0.5 for n in size)
    v, u = (axis.flatten().repeat(t).expand(len(like), -1) for axis in torch.meshgrid(rows, columns, indexing="ij"))
    frame = torch.arange(t, device=like.device).repeat_interleave(size[0] * size[1]).expand(len(like), -1)
    return Rays(frame, u, v, torch.full_like(u, NEAREST_MM))


def _bend(depth: Float[Tensor, "s t h w"], axis: int) -> Float[Tensor, "s t h w"]:
    """Absolute second difference along an axis; the border repeats."""
    padding = (1, 1, 0, 0) if axis == 3 else (0, 0, 1, 1)
    padded = F.pad(depth, padding, mode="replicate")
    count = depth.shape[axis]
    return (padded.narrow(axis, 0, count) + padded.narrow(axis, 2, count) - 2 * depth).abs()


def _supersampled(scene: SceneTensors, radiance: Points, rough: Bool[Tensor, "s n"], rays: Rays) -> Points:
    """Radiance with the rough pixels replaced by the mean of four rays each."""
    index, present = compact(rough)
    if index.shape[1] == 0:
        return radiance
    frame, u, v, start = (pick(values, index) for values in rays)
    corners = [(0.5 * (k % 2) - 0.25, 0.5 * (k // 2) - 0.25) for k in range(4)]
    four = Rays(
        frame.repeat(1, 4),
        torch.cat([u + du for du, _ in corners], 1),
        torch.cat([v + dv for _, dv in corners], 1),
        start.repeat(1, 4),
    )
    return put(radiance, index, present, cast_rays(scene, four)[1].unflatten(2, (4, -1)).mean(2))


def cast_rays(scene: SceneTensors, rays: Rays) -> tuple[Values, Points, Values]:
    """Trace and shade rays.

    Returns:
        Z-depth, 0 where a ray left the map; radiance; how much of it is highlight.
    """
    intrinsics, poses = scene.intrinsics, scene.scene_from_camera
    a = (rays.u - intrinsics[:, 0, 2:3]) / intrinsics[:, 0, 0:1]
    b = (rays.v - intrinsics[:, 1, 2:3]) / intrinsics[:, 1, 1:2]
    slant = torch.sqrt(a * a + b * b + 1)
    right, down, forward, origin = (pick(poses[:, :, :3, axis].permute(2, 0, 1), rays.frame) for axis in range(4))
    direction = (right * a + down * b + forward) / slant
    distance = trace(scene.surface, rays.start, origin, direction)
    points = origin + distance * direction
    view = View(points, origin, rays.frame, distance, distance / intrinsics[:, 0, 0:1])
    radiance, highlight = shade(scene, view)
    there = free_depth(scene.surface, points).abs() < ON_SURFACE_MM
    return torch.where(there, distance / slant, 0.0), radiance, highlight

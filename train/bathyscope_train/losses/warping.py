"""Where the pixels of one frame land in another: the geometry that the consistency losses share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.model.unprojection import invert_rigid, unproject

NEAREST = 1e-6
"""Depth behind which a point has no pixel, as a share of the depth that it was lifted with."""


@dataclass(frozen=True, slots=True)
class FramePairs:
    """Numbers of the frames of p pairs of a clip."""

    source: tuple[int, ...]
    target: tuple[int, ...]

    @classmethod
    def apart(cls, frames: int, stride: int, *, both_ways: bool = False) -> FramePairs:
        """Every frame t with t + ``stride``; and back again if ``both_ways``.

        Raises:
            GeometryError: If the clip is too short to hold one pair.
        """
        if frames <= stride:
            raise GeometryError(f"stride {stride} needs a clip of at least {stride + 1} frames, got {frames}")
        first, second = tuple(range(frames - stride)), tuple(range(stride, frames))
        return cls(first + second, second + first) if both_ways else cls(first, second)


@dataclass(frozen=True, slots=True)
class Meeting:
    """Every pixel of the source frames, seen from the target frame of its pair."""

    pixels: Float[Tensor, "b p h w 2"]
    """Where it lands (u, v); anywhere if it lies behind the camera."""
    expected: Float[Tensor, "b p h w"]
    """Its z-depth there; at or below 0 behind the camera."""
    observed: Float[Tensor, "b p h w"]
    """The target's own depth where it lands, bilinear; outside, that of the nearest pixel."""
    lands: Bool[Tensor, "b p h w"]
    """Whether it comes from a valid pixel, lies ahead, and its four neighbours in the target exist and are valid."""
    found: Bool[Tensor, "b p h w"]
    """Whether it comes from a valid pixel, and ``observed`` is made of valid pixels only."""


def meet(
    depth: Float[Tensor, "b t h w"],
    intrinsics: Float[Tensor, "b t 3 3"],
    world_from_camera: Float[Tensor, "b t 4 4"],
    valid: Bool[Tensor, "b t h w"],
    pairs: FramePairs,
) -> Meeting:
    """Lift the pixels of every source frame (Eq. 3) and look at them from their target frame.

    Args:
        depth: Z-depth, in the unit of the poses.
        intrinsics: In pixels of the size of ``depth``.
        world_from_camera: Camera poses.
        valid: Pixels whose depth means something; those without depth never count.
        pairs: Which frames.
    """
    source, target = list(pairs.source), list(pairs.target)
    known = valid & (depth > 0)
    depth = depth.where(known, depth.new_zeros(()))
    points = unproject(depth[:, source], intrinsics[:, source], world_from_camera[:, source])
    pixels, expected = project(points, intrinsics[:, target], world_from_camera[:, target])
    observed = sample_bilinear(depth[:, target], pixels)
    found = known[:, source] & (sample_bilinear(known[:, target].to(depth.dtype), pixels.detach()) > 1 - 1e-4)
    inside = in_bounds(pixels, (depth.shape[-2], depth.shape[-1]))
    return Meeting(pixels, expected, observed, inside & (expected > 0) & found, found)


def project(
    points: Float[Tensor, "*b h w 3"], intrinsics: Float[Tensor, "*b 3 3"], world_from_camera: Float[Tensor, "*b 4 4"]
) -> tuple[Float[Tensor, "*b h w 2"], Float[Tensor, "*b h w"]]:
    """Pixels (u, v) and z-depths of world points; the other way of ``unproject``.

    Points at or behind the camera get the pixel of a point that is barely ahead of it.
    """
    camera_from_world = invert_rigid(world_from_camera)
    rotation, translation = camera_from_world[..., :3, :3], camera_from_world[..., :3, 3]
    moved = (points.flatten(-3, -2) @ rotation.transpose(-1, -2)).reshape(points.shape)
    moved = moved + translation[..., None, None, :]
    z = moved[..., 2]
    safe = torch.maximum(z, NEAREST * moved.detach().norm(dim=-1) + torch.finfo(z.dtype).tiny)
    focal, principal = intrinsics[..., [0, 1], [0, 1]], intrinsics[..., :2, 2]
    return focal[..., None, None, :] * moved[..., :2] / safe[..., None] + principal[..., None, None, :], z


def sample_bilinear(maps: Float[Tensor, "b p h w"], pixels: Float[Tensor, "b p i j 2"]) -> Float[Tensor, "b p i j"]:
    """Values of maps between pixel centres, which are at +0.5; outside, those of the nearest pixel."""
    height, width = maps.shape[-2:]
    grid = 2 * pixels / pixels.new_tensor((width, height)) - 1
    sampled = F.grid_sample(
        maps.flatten(0, 1)[:, None],
        grid.flatten(0, 1),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    values: Tensor = sampled[:, 0].unflatten(0, maps.shape[:2])
    return values


def in_bounds(pixels: Float[Tensor, "*n 2"], size: tuple[int, int]) -> Bool[Tensor, "*n"]:
    """Positions whose four neighbouring pixel centres all lie in an image of ``size`` (height, width)."""
    u, v = pixels[..., 0], pixels[..., 1]
    return (u >= 0.5) & (u <= size[1] - 0.5) & (v >= 0.5) & (v <= size[0] - 0.5)

"""Clips whose depth is known in closed form: cameras before a plane."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

HEIGHT, WIDTH, FOCAL = 16, 20, 16.0


@dataclass(frozen=True)
class FlatClip:
    depth: Tensor
    """(b, t, h, w)"""
    intrinsics: Tensor
    world_from_camera: Tensor
    valid: Tensor

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.depth, self.intrinsics, self.world_from_camera, self.valid


def plane_clip(
    *,
    frames: int = 8,
    step: tuple[float, float, float] = (0.03, -0.02, 0.1),
    turn: float = 0.02,
    tilt: tuple[float, float] = (0.2, -0.1),
    distance: float = 3.0,
    dtype: torch.dtype = torch.float64,
) -> FlatClip:
    """A camera that moves and turns about y before the plane z = distance + tilt . (x, y) of the world."""
    poses = torch.eye(4, dtype=dtype).repeat(frames, 1, 1)
    number = torch.arange(frames, dtype=dtype)
    angle = turn * number
    poses[:, 0, 0] = poses[:, 2, 2] = angle.cos()
    poses[:, 0, 2], poses[:, 2, 0] = angle.sin(), -angle.sin()
    poses[:, :3, 3] = number[:, None] * torch.tensor(step, dtype=dtype)
    k = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=dtype)
    v, u = torch.meshgrid(
        torch.arange(HEIGHT, dtype=dtype) + 0.5, torch.arange(WIDTH, dtype=dtype) + 0.5, indexing="ij"
    )
    rays = torch.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, torch.ones_like(u)], -1)
    # normal . (R (d ray) + t) = distance
    normal = torch.tensor([-tilt[0], -tilt[1], 1], dtype=dtype)
    along = (rays @ poses[:, None, :3, :3].transpose(-1, -2)) @ normal
    depth = (distance - poses[:, :3, 3] @ normal)[:, None, None] / along
    return FlatClip(
        depth[None], k.expand(1, frames, 3, 3), poses[None], torch.ones(1, frames, HEIGHT, WIDTH, dtype=torch.bool)
    )

"""A rendered clip with its true geometry, and depths that are wrong in the ways that training goes wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from bathyscope_train.data.synthetic.clip import render_clip
from bathyscope_train.data.synthetic.domain import (
    CameraRanges,
    Domain,
    Family,
    LightRanges,
    MaterialRanges,
    SensorRanges,
)
from bathyscope_train.model.gaussian_parameters import GaussianBatch, footprint_gaussians
from bathyscope_train.model.unprojection import unproject

_SCALE_LOGIT, _OPACITY_LOGIT = -1.5, 4.0


@dataclass(frozen=True)
class TrueClip:
    """One clip; lengths in units of its mean depth."""

    frames: Tensor
    """(1, t, 3, h, w)"""
    depth: Tensor
    valid: Tensor
    world_from_camera: Tensor
    intrinsics: Tensor
    """(1, t, 3, 3)"""

    @property
    def size(self) -> tuple[int, int]:
        return self.depth.shape[-2], self.depth.shape[-1]

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.depth, self.intrinsics, self.world_from_camera, self.valid


def evenly_lit(family: Family, speed: float = 6.0) -> Domain:
    """Light from everywhere, matt and textured surfaces, no noise: appearance says only where things are."""
    return Domain(
        name="even",
        families={family: 1.0},
        light=LightRanges(falloff=(0, 0), spot=(0, 0), ambient=(30, 30)),
        material=MaterialRanges(specular=(0, 0), mottle=(0.3, 0.3), vessels=(60, 60), vessel_contrast=(0.6, 0.6)),
        camera=CameraRanges(speed=(speed, speed), motions={"orbit": 1.0}, fov_deg=(70, 70)),
        sensor=SensorRanges(noise=(0, 0), vignette=(0, 0), lag=(0, 0), blur_px=(0, 0)),
    )


def true_clip(seed: int, domain: Domain, *, frames: int = 7, size: tuple[int, int] = (98, 126)) -> TrueClip:
    clip = render_clip(seed, domain, frames=frames, size=size)
    depth, valid = torch.from_numpy(clip.depth)[None], torch.from_numpy(clip.valid)[None]
    unit = depth[valid].mean()
    poses = torch.from_numpy(clip.world_from_camera).float()[None]
    poses[..., :3, 3] /= unit
    return TrueClip(
        frames=torch.from_numpy(clip.frames).permute(0, 3, 1, 2)[None].float() / 255,
        depth=depth / unit,
        valid=valid,
        world_from_camera=poses,
        intrinsics=torch.from_numpy(clip.intrinsics).float().expand(1, frames, 3, 3),
    )


def shrunk(clip: TrueClip, factor: float) -> TrueClip:
    """Depth and poses together: the same clip in another unit."""
    poses = clip.world_from_camera.clone()
    poses[..., :3, 3] *= factor
    return replace(clip, depth=factor * clip.depth, world_from_camera=poses)


def wrong_depths(clip: TrueClip) -> dict[str, TrueClip]:
    """The same cameras with depth that is scaled, smoothed, bowl-shaped, constant or flickering."""
    depth, middle = clip.depth, clip.depth[clip.valid].median()
    height, width = clip.size
    v, u = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    bowl = 1.3 - 0.45 * (u * u + v * v)
    waver = torch.tensor([1.0, -1, -1, 1, 1, -1, 1, -1]).repeat(4)[: depth.shape[1], None, None]
    made = {
        "x 0.8": 0.8 * depth,
        "x 1.25": 1.25 * depth,
        "smoothed": _smoothed(clip),
        "times a bowl": depth * bowl / bowl.mean(),
        "a bowl": (middle * bowl / bowl.mean()).expand_as(depth),
        "constant": middle.expand_as(depth),
        "flicker 10 %": depth * (1 + 0.1 * waver),
    }
    return {name: replace(clip, depth=wrong.where(clip.valid, wrong.new_zeros(()))) for name, wrong in made.items()}


def _smoothed(clip: TrueClip, cells: tuple[int, int] = (3, 4)) -> Tensor:
    """Means over a coarse grid of cells, joined bilinearly."""
    weight = clip.valid.float()
    mean = F.adaptive_avg_pool2d(clip.depth * weight, cells) / F.adaptive_avg_pool2d(weight, cells).clamp_min(1e-3)
    return F.interpolate(mean, clip.size, mode="bilinear", align_corners=False)


def painted(clip: TrueClip) -> GaussianBatch:
    """One small, nearly opaque Gaussian in the colour of each pixel, at its depth."""
    _, frames, height, width = clip.depth.shape
    raw = torch.zeros(1, frames, height * width, 11)
    raw[..., 0], raw[..., 1:4] = _OPACITY_LOGIT, _SCALE_LOGIT
    scene = footprint_gaussians(
        unproject(clip.depth, clip.intrinsics, clip.world_from_camera).flatten(2, 3),
        raw,
        footprint=clip.depth.flatten(2) / clip.intrinsics[..., 0, 0][..., None],
        colours=clip.frames.flatten(3).transpose(2, 3),
        rotation=clip.world_from_camera[..., :3, :3],
    )
    return replace(scene, opacities=scene.opacities * clip.valid.flatten(1))

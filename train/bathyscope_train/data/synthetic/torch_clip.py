"""Render clips in torch, many at once, on the device where they are used.

The same plans give the same pictures as ``render_clip`` but for the noise, whose numbers come from the device, and for
rounding. Scenes are drawn on the CPU, ahead of time in other processes if wanted (``torch_stream``).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from bathyscope_train.data.synthetic.clip import ClipPlan, from_first_camera, plan_clip
from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.torch_formation import form_images, image_motion
from bathyscope_train.data.synthetic.torch_metering import views
from bathyscope_train.data.synthetic.torch_optics import develop
from bathyscope_train.data.synthetic.torch_rendering import render_scenes
from bathyscope_train.data.synthetic.torch_scene import scene_tensors
from bathyscope_train.data.synthetic.torch_support import check_plans


@dataclass(frozen=True, slots=True)
class ClipBatch:
    """Rendered clips of one length and size on one device. Lengths are millimetres."""

    frames: UInt8[Tensor, "b t 3 h w"]
    depth: Float[Tensor, "b t h w"]
    """Z-depth of the ray through each pixel's centre; 0 outside the field of view."""
    valid: Bool[Tensor, "b t h w"]
    """Inside the field of view, and the scene is there."""
    moving: Bool[Tensor, "b t h w"]
    """Instruments, whose motion is not the camera's."""
    world_from_camera: Float[Tensor, "b t 4 4"]
    """The first frame of each clip is the identity."""
    intrinsics: Float[Tensor, "b 3 3"]
    distortion: Float[Tensor, "b 2"]
    """k1 and k2 of each lens; see ``lens``."""
    names: tuple[str, ...]


def render_clips(
    seeds: Iterable[int],
    domain: Domain,
    *,
    frames: int = 16,
    size: tuple[int, int] = (112, 140),
    device: torch.device | str = "cpu",
    generator: torch.Generator | None = None,
) -> ClipBatch:
    """Render one clip a seed; what ``render_clip`` renders for these seeds, up to noise and rounding.

    Args:
        seeds: Numbers of the clips, at least 0.
        domain: What scenes, light, camera and sensor may look like.
        frames: Length.
        size: Height and width in pixels.
        device: Where to render.
        generator: Source of the noise, on ``device``.

    Raises:
        SettingsError: If seed, length or size cannot be used, or the domain has what this renderer has not.
    """
    plans = [plan_clip(seed, domain, frames=frames, size=size) for seed in seeds]
    return render_plans(plans, device=device, generator=generator)


def render_plans(
    plans: Sequence[ClipPlan],
    *,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    generator: torch.Generator | None = None,
    compiled: bool = False,
) -> ClipBatch:
    """Render clips that are planned; see :func:`render_clips`.

    Args:
        plans: Clips of one length and size, of any families; those of one scene share its memory.
        device: Where to render.
        dtype: float32, or float64 to look for differences.
        generator: Source of the noise, on ``device``.
        compiled: Trace and shade by compiled code; pays where very many clips are rendered.

    Raises:
        SettingsError: If a plan has what this renderer has not.
    """
    check_plans(plans)
    kinds = [(plan.scene.surface.kind, _has_solids(plan)) for plan in plans]
    groups = [[index for index, kind in enumerate(kinds) if kind == wanted] for wanted in sorted(set(kinds))]
    parts = [
        _render([plans[index] for index in group], device, dtype, generator, compiled=compiled) for group in groups
    ]
    order = torch.tensor(np.argsort(np.concatenate(groups)), device=parts[0].frames.device)
    return ClipBatch(
        frames=torch.cat([part.frames for part in parts])[order],
        depth=torch.cat([part.depth for part in parts])[order],
        valid=torch.cat([part.valid for part in parts])[order],
        moving=torch.cat([part.moving for part in parts])[order],
        world_from_camera=torch.cat([part.world_from_camera for part in parts])[order],
        intrinsics=torch.cat([part.intrinsics for part in parts])[order],
        distortion=torch.cat([part.distortion for part in parts])[order],
        names=tuple(plan.name for plan in plans),
    )


def _has_solids(plan: ClipPlan) -> bool:
    return len(plan.scene.solids.kind) + len(plan.instruments.solids.kind) > 0


def _render(
    plans: Sequence[ClipPlan],
    device: torch.device | str,
    dtype: torch.dtype,
    generator: torch.Generator | None,
    *,
    compiled: bool,
) -> ClipBatch:
    """Clips whose scenes have one kind of surface, and all solids or none."""
    pictures = render_scenes(scene_tensors(plans, device, dtype, compiled=compiled), plans[0].size)
    radiance, depth, mover = (values.unflatten(0, (len(plans), -1)) for values in pictures)
    sensors = [plan.sensor for plan in plans]
    poses, intrinsics, distortion = (
        torch.from_numpy(np.stack(values)).to(depth)
        for values in zip(*((plan.scene_from_camera, plan.intrinsics, plan.distortion) for plan in plans), strict=True)
    )

    def motion(chosen: list[int]) -> Float[Tensor, "b t 2 h w"]:
        return image_motion(depth[chosen], poses[chosen], intrinsics[chosen], distortion[chosen])

    focal = [float(plan.intrinsics[0, 0]) for plan in plans]
    formed = form_images(radiance, depth, motion, focal, sensors)
    valid = (views(sensors, depth)[:, 0] >= 0.5) & (depth > 0)
    world_from_camera = np.stack([from_first_camera(plan.scene_from_camera) for plan in plans])
    return ClipBatch(
        frames=develop(formed, sensors, generator),
        depth=torch.where(valid, depth, 0.0),
        valid=valid,
        moving=valid & (mover > 0),
        world_from_camera=torch.from_numpy(world_from_camera).to(depth),
        intrinsics=intrinsics,
        distortion=distortion,
        names=tuple(plan.name for plan in plans),
    )

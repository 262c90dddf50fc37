"""A frame that is left out, rendered from the Gaussians of the others: photometric supervision through the splats."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.photometric import photometric_loss
from bathyscope_train.model.network import DenseMaps
from bathyscope_train.model.presets import SceneSettings
from bathyscope_train.model.scene import world_gaussians
from bathyscope_train.render import Renderer


def held_out_view_loss(
    maps: DenseMaps, batch: Batch, frame: int, settings: SceneSettings, render: Renderer
) -> Float[Tensor, ""]:
    """Mean absolute colour difference between a frame and what the other frames' Gaussians show of it.

    Cameras are the true ones. The colour is divided by the opacity, so that nearly transparent Gaussians are judged by
    what they show and not by how dark they are. What is outside the field of view or moves by itself neither becomes a
    Gaussian nor counts.

    Args:
        maps: Dense maps of the clips; depth in the unit of the poses.
        batch: Images, true poses and focal length.
        frame: The frame that is left out and rendered.
        settings: The preset's reading of the raw Gaussians.
        render: Differentiable splatting.
    """
    height, width = batch.images.shape[-2:]
    others = [k for k in range(batch.images.shape[1]) if k != frame]
    intrinsics = torch.zeros(*batch.images.shape[:2], 3, 3, dtype=maps.depth.dtype, device=maps.depth.device)
    intrinsics[..., 0, 0] = intrinsics[..., 1, 1] = batch.focal[:, None]
    intrinsics[..., 0, 2], intrinsics[..., 1, 2], intrinsics[..., 2, 2] = width / 2, height / 2, 1
    assert maps.gaussians is not None
    part = DenseMaps(maps.depth[:, others], maps.confidence[:, others], maps.gaussians[:, others])
    poses = batch.world_from_camera
    scene = world_gaussians(part, batch.images[:, others], poses[:, others], intrinsics[:, others], settings)
    hidden = ~(batch.valid & ~batch.moving)[:, others].flatten(1)
    scene = replace(scene, opacities=scene.opacities * (~hidden).to(scene.opacities.dtype))
    view = render(scene, poses[:, [frame]], intrinsics[:, [frame]], (height, width))
    counts = batch.valid[:, [frame]] & ~batch.moving[:, [frame]]
    return photometric_loss(view.image, batch.images[:, [frame]], counts, opacity=view.opacity, reduction="mean")

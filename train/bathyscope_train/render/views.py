"""Which Gaussians a view is made of: all, all but its own, and never those of black borders."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render.contract import Renderer, Rendering


def inside_only(scene: GaussianBatch, inside: Bool[Tensor, "b t h w"]) -> GaussianBatch:
    """The scene without the Gaussians of pixels outside the field of view, which get an opacity of exactly 0.

    Renderers leave those out, and they get no gradient: black borders never become part of a scene.

    Args:
        scene: One Gaussian a pixel, frame by frame and row by row; voxels fused over frames have no pixel any more.
        inside: Field of view.

    Raises:
        GeometryError: If there is not one Gaussian for each pixel.
    """
    _check_aligned(scene, inside.shape[1], inside[0, 0].numel())
    return replace(scene, opacities=scene.opacities * inside.flatten(1))


def leave_one_out(
    renderer: Renderer,
    scene: GaussianBatch,
    world_from_camera: Float[Tensor, "b t 4 4"],
    intrinsics: Float[Tensor, "b t 3 3"],
    size: tuple[int, int],
) -> Rendering:
    """Render every frame from the Gaussians of all *other* frames.

    A frame's own Gaussians repaint it whatever their depth; without them the others have to be in the right place.

    Args:
        renderer: Any.
        scene: An equal number of Gaussians from each of the t frames, frame by frame.
        world_from_camera: Camera poses.
        intrinsics: In pixels of ``size``.
        size: (height, width).

    Raises:
        GeometryError: If the Gaussians cannot be told apart by frame, or there is one frame only.
    """
    frames = world_from_camera.shape[1]
    if frames < 2:
        raise GeometryError("leaving a frame out needs at least 2 frames, got 1")
    if scene.opacities.shape[1] % frames:
        raise GeometryError(
            f"{scene.opacities.shape[1]} Gaussians do not come from {frames} frames in equal parts; fused voxels have "
            "no frame to leave out: render all of them, or do not fuse"
        )
    views = []
    for frame in range(frames):
        others = torch.ones(frames, 1, dtype=scene.opacities.dtype, device=scene.opacities.device)
        others[frame] = 0
        opacities = (scene.opacities.unflatten(1, (frames, -1)) * others).flatten(1)
        one = slice(frame, frame + 1)
        views.append(renderer(replace(scene, opacities=opacities), world_from_camera[:, one], intrinsics[:, one], size))
    names = ("image", "depth", "accumulated", "opacity")
    return Rendering(*(torch.cat([getattr(view, name) for view in views], dim=1) for name in names))


def _check_aligned(scene: GaussianBatch, frames: int, pixels: int) -> None:
    count = scene.opacities.shape[1]
    if count != frames * pixels:
        raise GeometryError(
            f"{count} Gaussians are not one for each of {frames} x {pixels} pixels; mask pixels before voxels are fused"
        )

"""What a clip looks like from its own cameras: the rendered image and depth that the losses compare."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.consistency.geometry import ClipGeometry
from bathyscope_train.consistency.terms import ImageTerm
from bathyscope_train.render import Renderer, leave_one_out


@dataclass(frozen=True, slots=True)
class ClipRendering:
    """Maps of every frame."""

    depth: Float[Tensor, "b t h w"]
    """Rendered from all Gaussians; that of the head for a network without any."""
    opacity: Float[Tensor, "b t h w"]
    image: Float[Tensor, "b t 3 h w"] | None
    """From the Gaussians that the image term asks for; None where it has no weight."""
    image_opacity: Float[Tensor, "b t h w"] | None


def render_clip(geometry: ClipGeometry, renderer: Renderer, term: ImageTerm) -> ClipRendering:
    """Render every frame of every clip (Eq. 1): depth from all Gaussians, the image from those that ``term`` names."""
    if geometry.gaussians is None:
        return ClipRendering(geometry.depth, torch.ones_like(geometry.depth), None, None)
    size = (geometry.depth.shape[-2], geometry.depth.shape[-1])
    cameras = geometry.world_from_camera, geometry.intrinsics
    whole = renderer(geometry.gaussians, *cameras, size)
    if term.weight == 0:
        return ClipRendering(whole.depth, whole.opacity, None, None)
    view = whole if term.views == "all" else leave_one_out(renderer, geometry.gaussians, *cameras, size)
    return ClipRendering(whole.depth, whole.opacity, view.image, view.opacity)

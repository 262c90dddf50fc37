"""What a clip looks like from its own cameras: the rendered image and depth that the losses compare."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

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
    """Rendered from all Gaussians; that of the head where it is not rendered."""
    opacity: Float[Tensor, "b t h w"]
    """Of what ``depth`` was rendered from; 1 where it is the head's."""
    image: Float[Tensor, "b t 3 h w"] | None = None
    """From the Gaussians that the image term asks for; None where it has no weight."""
    image_opacity: Float[Tensor, "b t h w"] | None = None


def render_clip(
    geometry: ClipGeometry, renderer: Renderer, term: ImageTerm, *, depth: Literal["rendered", "placed"] = "rendered"
) -> ClipRendering:
    """Render every frame of every clip (Eq. 1): depth from all Gaussians, the image from those that ``term`` names.

    Args:
        geometry: Cameras and Gaussians.
        renderer: Differentiable splatting.
        term: Without a weight no image is rendered.
        depth: ``placed`` takes the depth at which each frame placed its Gaussians instead of rendering one.
    """
    scene, placed = geometry.gaussians, placed_depth(geometry)
    if scene is None:
        return placed
    size = (geometry.depth.shape[-2], geometry.depth.shape[-1])
    cameras = geometry.world_from_camera, geometry.intrinsics
    wanted = depth == "rendered" or (term.weight > 0 and term.views == "all")
    whole = renderer(scene, *cameras, size) if wanted else None
    own = placed if whole is None or depth == "placed" else ClipRendering(whole.depth, whole.opacity)
    if term.weight == 0:
        return own
    view = leave_one_out(renderer, scene, *cameras, size) if whole is None or term.views == "others" else whole
    return replace(own, image=view.image, image_opacity=view.opacity)


def placed_depth(geometry: ClipGeometry) -> ClipRendering:
    """The depth of the head, as the camera head corrected it: that of the Gaussians' centres."""
    return ClipRendering(geometry.depth, torch.ones_like(geometry.depth))

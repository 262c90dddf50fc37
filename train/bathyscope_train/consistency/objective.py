"""The objective L = λ1 L_rgb + λ2 L_3D + λ3 L_temp on what is rendered, and two terms that are not in the paper."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.consistency.geometry import ClipGeometry
from bathyscope_train.consistency.rendering import ClipRendering
from bathyscope_train.consistency.terms import ObjectiveSettings, TemporalTerm
from bathyscope_train.losses.matches import matches_loss
from bathyscope_train.losses.photometric import photometric_loss
from bathyscope_train.losses.temporal import moving_edges_loss, temporal_gradient_loss
from bathyscope_train.losses.valid import photometric_pixels, solid_pixels
from bathyscope_train.losses.world import meeting_pixels, world_consistency_loss


def consistency_terms(
    rendered: ClipRendering,
    geometry: ClipGeometry,
    before: ClipGeometry,
    *,
    images: Float[Tensor, "b t 3 h w"],
    inside: Bool[Tensor, "b h w"],
    settings: ObjectiveSettings,
    progress: float = 1.0,
) -> dict[str, Float[Tensor, ""]]:
    """The terms that have a weight at this ``progress`` (0 to 1) of the run, without their factors.

    Args:
        rendered: Image and depth of every frame.
        geometry: Cameras and depth of the network as it is.
        before: The same of the network before training; no gradient reaches it.
        images: The frames.
        inside: Field of view.
        settings: The terms.
        progress: Share of the run that is over.
    """
    terms = {}
    solid = solid_pixels(rendered.opacity.detach(), inside)
    cameras = geometry.intrinsics, geometry.world_from_camera
    if settings.image.weight > 0 and rendered.image is not None:
        terms["image"] = photometric_loss(
            rendered.image,
            images,
            photometric_pixels(images, inside),
            opacity=rendered.image_opacity if settings.image.divide_by_opacity else None,
            reduction=settings.image.reduction,
        )
    if settings.world.weight > 0:
        world = settings.world
        terms["world"] = world_consistency_loss(
            rendered.depth,
            *cameras,
            solid,
            stride=world.stride,
            delta=world.delta,
            scale_free=world.scale_free,
            both_ways=world.both_ways,
            reduction=world.reduction,
            meets=_meets(before, inside, settings, world.stride, both_ways=world.both_ways),
        )
    if settings.temporal.weight > 0 and progress >= settings.temporal.start:
        meets = _meets(before, inside, settings, settings.temporal.stride)
        terms["temporal"] = _temporal(rendered.depth, cameras, solid, settings.temporal, meets)
    if settings.matches.weight > 0 and geometry.seen is not None:
        terms["matches"] = matches_loss(geometry.seen, delta=settings.matches.delta)
    if settings.anchor.weight > 0:
        terms["anchor"] = anchor_loss(geometry.depth, before.depth, inside)
    return terms


def anchor_loss(
    depth: Float[Tensor, "b t h w"], before: Float[Tensor, "b t h w"], inside: Bool[Tensor, "b h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of log depth from that of the network before training, inside the field of view.

    Not in the paper. It holds what the other terms leave free: the scale of the scene, and pixels that no other frame
    sees. It takes the depth of the head, since rendered depth could be kept out of it by opening holes.
    """
    difference = (depth.log() - before.log()).abs().mean(1)
    return (difference * inside).sum() / inside.sum().clamp_min(1)


def weighted_sum(terms: Mapping[str, Tensor], weights: Mapping[str, float]) -> Float[Tensor, ""]:
    """Sum of the terms times their weights."""
    return torch.stack([weights[name] * term for name, term in terms.items()]).sum()


def _temporal(
    depth: Tensor, cameras: tuple[Tensor, Tensor], solid: Tensor, term: TemporalTerm, meets: Tensor | None
) -> Tensor:
    if term.kind == "literal":
        return temporal_gradient_loss(depth, solid, stride=term.stride, scales=term.scales)
    return moving_edges_loss(depth, *cameras, solid, stride=term.stride, scales=term.scales, meets=meets)


def _meets(
    before: ClipGeometry, inside: Tensor, settings: ObjectiveSettings, stride: int, *, both_ways: bool = False
) -> Tensor | None:
    """The valid set of the network before training, where the settings want it fixed."""
    if not settings.world.fixed_pixels:
        return None
    valid = inside[:, None].expand_as(before.depth)
    return meeting_pixels(
        before.depth, before.intrinsics, before.world_from_camera, valid, stride=stride, both_ways=both_ways
    )

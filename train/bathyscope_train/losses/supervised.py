"""The objective of pre-training: all supervised terms of one batch, weighted."""

from dataclasses import dataclass, replace

import torch
from pydantic import BaseModel, NonNegativeFloat
from torch import Tensor

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.camera import focal_loss, induced_flow_loss, length, motion_loss
from bathyscope_train.losses.depth import confidence_loss, gradient_loss, log_depth_loss, normal_loss, safe_log
from bathyscope_train.losses.gaussian_targets import gaussian_loss
from bathyscope_train.losses.held_out_view import held_out_view_loss
from bathyscope_train.losses.matching import flow_loss, matching_cross_entropy, true_matches
from bathyscope_train.model.matching_camera_head import MatchingCameraHead, image_diagonal
from bathyscope_train.model.network import DenseMaps, Features, Network
from bathyscope_train.model.pose_layer import Motion
from bathyscope_train.model.rigid import rotation_exponential, rotation_logarithm
from bathyscope_train.model.trajectory import ClipPairs
from bathyscope_train.render import CpuRenderer, GsplatRenderer, Renderer


class LossWeights(BaseModel, frozen=True, extra="forbid"):
    """Factors of the terms; measured to work together at 112x140."""

    depth: NonNegativeFloat = 1.0
    gradient: NonNegativeFloat = 0.5
    normals: NonNegativeFloat = 0.1
    confidence: NonNegativeFloat = 0.1
    focal: NonNegativeFloat = 0.5
    matching: NonNegativeFloat = 0.1
    flow: NonNegativeFloat = 0.05
    motion: NonNegativeFloat = 1.0
    induced_flow: NonNegativeFloat = 0.03
    corrected_depth: NonNegativeFloat = 0.5
    gaussians: NonNegativeFloat = 0.2
    photometric: NonNegativeFloat = 0.0


_CAMERA_TERMS = ("focal", "matching", "flow", "motion", "induced_flow", "corrected_depth")


@dataclass(frozen=True, slots=True)
class Objective:
    """The weighted sum, and its terms before weighting."""

    total: Tensor
    terms: dict[str, Tensor]


@dataclass(frozen=True, slots=True)
class SolverInput:
    """What the motion solver is given in this step, so that it learns from good and from poor guesses."""

    true_focal: bool = True
    """The true focal length as first estimate, rather than the predicted one times ``focal_error``."""
    focal_error: float = 1.0
    true_motion: bool = False
    """Correct the depth under the true motions, rather than the estimated ones."""
    hint_error: float | None = None
    """Let the last look follow the true motions, each turned and shifted by about this share of itself, as the steps
    from frame to frame would lead it; None for the motions of the first look."""
    hint_seed: int = 0
    held_out: int = 0
    """Frame that the others' Gaussians have to show."""


def supervised_objective(
    network: Network,
    batch: Batch,
    pairs: ClipPairs,
    weights: LossWeights,
    given: SolverInput | None = None,
    *,
    autocast: bool = False,
) -> Objective:
    """Run the network on a batch and compare everything it says with the truth.

    Args:
        network: With a matching camera head.
        batch: Windows with depth, poses and focal length.
        pairs: Pairs of frames whose motions are supervised.
        weights: Factors of the terms.
        given: What the solver starts from.
        autocast: Run the transformer in bfloat16; heads, solver and losses stay in float32.
    """
    given = given or SolverInput()
    with torch.autocast(batch.images.device.type, dtype=torch.bfloat16, enabled=autocast):
        features = _in_float32(network.encode(batch.images))
    maps = network.dense(features, batch.images)
    terms = {
        "depth": log_depth_loss(maps.depth, batch.depth, batch.valid),
        "gradient": gradient_loss(maps.depth, batch.depth, batch.valid),
    }
    factors = weights.model_dump()
    if factors["normals"] > 0:
        terms["normals"] = normal_loss(maps.depth, batch.depth, batch.valid, batch.focal)
    final = maps.depth.detach()
    if any(factors[name] > 0 for name in _CAMERA_TERMS):
        more, final = _camera_terms(network, features, maps, batch, pairs=pairs, given=given)
        terms |= more
    error = (final.detach().log() - safe_log(batch.depth)).abs()
    terms["confidence"] = confidence_loss(maps.confidence, error, batch.valid)
    if maps.gaussians is not None:
        terms["gaussians"] = gaussian_loss(maps.gaussians, final.detach(), batch.depth, batch.valid, batch.focal)
        if factors["photometric"] > 0:
            terms["photometric"] = held_out_view_loss(
                replace(maps, depth=final), batch, given.held_out, network.preset.scene, splatting(batch.images.device)
            )
    total = torch.stack([factors[name] * term for name, term in terms.items()]).sum()
    return Objective(total, terms)


def _camera_terms(
    network: Network, features: Features, maps: DenseMaps, batch: Batch, *, pairs: ClipPairs, given: SolverInput
) -> tuple[dict[str, Tensor], Tensor]:
    """Terms of the camera head, and the depth as it corrected it."""
    head = network.camera_head
    assert isinstance(head, MatchingCameraHead)
    size = (batch.depth.shape[-2], batch.depth.shape[-1])
    focal = head.focal(features.camera) * image_diagonal(*size, like=batch.depth)
    # The solver sees the predicted depth as it is served, but sends no gradient into it: simpler and as good.
    depth = maps.depth.detach()
    clip = head.describe(features.taps[-1], features.stem_maps, depth)
    first = batch.focal if given.true_focal else focal.detach() * given.focal_error
    true = true_matches(batch, pairs)
    if given.hint_error is None:
        estimates = head.estimate(clip, first, pairs)
    else:
        hint = disturbed(true.motion, given.hint_error, given.hint_seed)
        shape = (batch.focal.shape[0], pairs.source.shape[0])
        per_clip = Motion(hint.rotation.unflatten(0, shape), hint.translation.unflatten(0, shape))
        estimates = head.estimate(clip, first, pairs, between=lambda motion: per_clip)
    refined = head.refine_focal(clip, estimates, first, pairs)
    motion = true.motion if given.true_motion else None
    correction = head.correct_depth(clip, estimates, refined.detach(), pairs, motion=motion)
    corrected = head.corrected(clip, depth, correction)
    sharper = clip.depth * correction.detach().exp()
    final = head.resolve(clip, estimates, refined.detach(), pairs, depth=sharper)
    rounds = [*(each.solution for each in estimates.rounds), final]
    shares = [0.5] + [1.0] * (len(rounds) - 1)
    return {
        "focal": focal_loss(focal, batch.focal) + focal_loss(refined, batch.focal),
        "matching": matching_cross_entropy(estimates.correlation, true, clip.principal),
        "flow": torch.stack([flow_loss(each.matches, true) for each in estimates.rounds]).sum(),
        "motion": torch.stack(
            [share * motion_loss(each.motion, true.motion) for share, each in zip(shares, rounds, strict=True)]
        ).sum(),
        "induced_flow": induced_flow_loss(final.motion, true),
        "corrected_depth": log_depth_loss(corrected, batch.depth, batch.valid)
        + 0.5 * gradient_loss(corrected, batch.depth, batch.valid),
    }, corrected


def disturbed(motion: Motion, share: float, seed: int) -> Motion:
    """Motions with their rotation vectors and translations off by about ``share`` of their lengths."""
    both = torch.stack([rotation_logarithm(motion.rotation), motion.translation])
    noise = torch.randn(both.shape, generator=torch.Generator().manual_seed(seed)).to(both)
    angles, translation = both + share * length(both)[..., None] * noise / 3**0.5
    return Motion(rotation_exponential(angles), translation)


def splatting(device: torch.device) -> Renderer:
    """The differentiable splatter for tensors on a device."""
    return GsplatRenderer() if device.type == "cuda" else CpuRenderer()


def _in_float32(features: Features) -> Features:
    return Features(
        taps=tuple(tap.float() for tap in features.taps),
        camera=features.camera.float(),
        stem_maps=tuple(each.float() for each in features.stem_maps),
    )

"""The objective of pre-training: all supervised terms of one batch, weighted."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from pydantic import BaseModel, NonNegativeFloat
from torch import Tensor

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.camera import focal_loss, induced_flow_loss, motion_loss
from bathyscope_train.losses.depth import confidence_loss, gradient_loss, log_depth_loss, safe_log
from bathyscope_train.losses.gaussian_targets import gaussian_loss
from bathyscope_train.losses.matching import flow_loss, matching_cross_entropy, true_matches
from bathyscope_train.model.matching_camera_head import MatchingCameraHead, image_diagonal
from bathyscope_train.model.network import DenseMaps, Features, Network


class LossWeights(BaseModel, frozen=True, extra="forbid"):
    """Factors of the terms; measured to work together at 112x140."""

    depth: NonNegativeFloat = 1.0
    gradient: NonNegativeFloat = 0.5
    confidence: NonNegativeFloat = 0.1
    focal: NonNegativeFloat = 0.5
    matching: NonNegativeFloat = 0.1
    flow: NonNegativeFloat = 0.05
    motion: NonNegativeFloat = 1.0
    induced_flow: NonNegativeFloat = 0.03
    gaussians: NonNegativeFloat = 0.2


@dataclass(frozen=True, slots=True)
class Objective:
    """The weighted sum, and its terms before weighting."""

    total: Tensor
    terms: dict[str, Tensor]


def supervised_objective(
    network: Network,
    batch: Batch,
    source: Int[Tensor, "p"],
    target: Int[Tensor, "p"],
    weights: LossWeights,
    *,
    true_focal: bool = True,
    autocast: bool = False,
) -> Objective:
    """Run the network on a batch and compare everything it says with the truth.

    Args:
        network: With a matching camera head.
        batch: Windows with depth, poses and focal length.
        source: Frames that supervised motions start from.
        target: Frames that they lead to.
        weights: Factors of the terms.
        true_focal: Give the solver the true focal length rather than the predicted one.
        autocast: Run the transformer in bfloat16; heads, solver and losses stay in float32.
    """
    with torch.autocast(batch.images.device.type, dtype=torch.bfloat16, enabled=autocast):
        features = _in_float32(network.encode(batch.images))
    maps = network.dense(features, batch.images)
    terms = {
        "depth": log_depth_loss(maps.depth, batch.depth, batch.valid),
        "gradient": gradient_loss(maps.depth, batch.depth, batch.valid),
        "confidence": confidence_loss(maps.confidence, (maps.depth.log() - safe_log(batch.depth)).abs(), batch.valid),
    }
    if maps.gaussians is not None:
        terms["gaussians"] = gaussian_loss(maps.gaussians, maps.depth.detach(), batch.depth, batch.valid, batch.focal)
    factors = weights.model_dump()
    if any(factors[name] > 0 for name in ("focal", "matching", "flow", "motion", "induced_flow")):
        terms |= _camera_terms(network, features, maps, batch, pairs=(source, target), true_focal=true_focal)
    total = torch.stack([factors[name] * term for name, term in terms.items()]).sum()
    return Objective(total, terms)


def _camera_terms(
    network: Network,
    features: Features,
    maps: DenseMaps,
    batch: Batch,
    *,
    pairs: tuple[Tensor, Tensor],
    true_focal: bool,
) -> dict[str, Tensor]:
    head = network.camera_head
    assert isinstance(head, MatchingCameraHead)
    size = (batch.depth.shape[-2], batch.depth.shape[-1])
    focal = head.focal(features.camera) * image_diagonal(*size, like=batch.depth)
    # The solver sees the predicted depth as it is served, but sends no gradient into it: simpler and as good.
    depth = maps.depth.detach()
    estimates = head.estimate(
        head.features(features.taps[-1], features.stem_maps, size),
        depth,
        batch.focal if true_focal else focal.detach(),
        *pairs,
    )
    true = true_matches(batch.depth, batch.world_from_camera, batch.focal, *pairs)
    first, last = estimates.rounds[0], estimates.rounds[-1]
    return {
        "focal": focal_loss(focal, batch.focal),
        "matching": matching_cross_entropy(estimates.correlation, true, estimates.principal),
        "flow": torch.stack([flow_loss(each.matches, true) for each in estimates.rounds]).sum(),
        "motion": 0.5 * motion_loss(first.solution.motion, true.motion)
        + motion_loss(last.solution.motion, true.motion),
        "induced_flow": induced_flow_loss(last.solution.motion, true),
    }


def _in_float32(features: Features) -> Features:
    return Features(
        taps=tuple(tap.float() for tap in features.taps),
        camera=features.camera.float(),
        stem_maps=tuple(each.float() for each in features.stem_maps),
    )

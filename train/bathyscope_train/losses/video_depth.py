r"""The supervised loss of Video Depth Anything: shape of every frame, and change from frame to frame.

Values are disparity or depth, whichever prediction and target share. The spatial term compares frames that are each
normalised by their median and mean absolute deviation from it; the temporal term fits one scale and shift for the
clip and compares what changes between neighbouring frames, where the target changes little.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope.errors import GeometryError

_LEAST_SPREAD = 1e-6


@dataclass(frozen=True, slots=True)
class VideoDepthLoss:
    """Both terms, weighted; their sum is the loss."""

    spatial: Float[Tensor, ""]
    temporal: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """The loss."""
        return self.spatial + self.temporal


def video_depth_loss(
    prediction: Float[Tensor, "b t h w"],
    target: Float[Tensor, "b t h w"],
    mask: Bool[Tensor, "b t h w"],
    *,
    gradient_weight: float = 0.5,
    scales: int = 4,
    temporal_weight: float = 10.0,
    steady: float = 0.05,
) -> VideoDepthLoss:
    """The loss of one batch of clips.

    Args:
        prediction: Up to a scale and a shift for each clip.
        target: Of the same kind.
        mask: Where the target is known.
        gradient_weight: Of the gradient term beside the absolute difference.
        scales: Gradients are compared at every 1st, 2nd, 4th ... pixel.
        temporal_weight: Of the temporal term.
        steady: A pixel takes part in the temporal term where the target changes by less than this share of the
            range of the later frame.

    Raises:
        GeometryError: If the shapes differ.
    """
    if not prediction.shape == target.shape == mask.shape or prediction.ndim != 4:
        raise GeometryError(
            f"the loss needs (b, t, h, w) three times, got {tuple(prediction.shape)}, {tuple(target.shape)} and "
            f"{tuple(mask.shape)}"
        )
    frames = prediction.flatten(0, 1).float(), target.flatten(0, 1).float(), mask.flatten(0, 1).float()
    spatial = _spatial(*frames, gradient_weight=gradient_weight, scales=scales)
    return VideoDepthLoss(spatial, temporal_weight * _temporal(prediction.float(), target.float(), mask, steady))


def _spatial(
    prediction: Float[Tensor, "n h w"],
    target: Float[Tensor, "n h w"],
    mask: Float[Tensor, "n h w"],
    *,
    gradient_weight: float,
    scales: int,
) -> Float[Tensor, ""]:
    difference = mask * (_normalised(prediction, mask) - _normalised(target, mask))
    loss = difference.abs().sum() / mask.sum().clamp_min(1)
    for step in (2**scale for scale in range(scales)):
        d, m = difference[:, ::step, ::step], mask[:, ::step, ::step]
        across = (d[:, :, 1:] - d[:, :, :-1]).abs() * m[:, :, 1:] * m[:, :, :-1]
        down = (d[:, 1:] - d[:, :-1]).abs() * m[:, 1:] * m[:, :-1]
        loss = loss + gradient_weight * (across.sum() + down.sum()) / m.sum().clamp_min(1)
    return loss


def _normalised(values: Float[Tensor, "n h w"], mask: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """Median 0 and mean absolute deviation 1; unknown pixels take part in the median as zeros, as published."""
    median = (mask * values).flatten(1).median(dim=1).values[:, None, None]
    centred = values - median
    spread = (mask * centred.abs()).sum((1, 2)) / mask.sum((1, 2)).clamp_min(1)
    return centred / spread.clamp_min(_LEAST_SPREAD)[:, None, None]


def _temporal(
    prediction: Float[Tensor, "b t h w"], target: Float[Tensor, "b t h w"], mask: Bool[Tensor, "b t h w"], steady: float
) -> Float[Tensor, ""]:
    fitted = _fitted(prediction, target, mask)
    infinity = torch.full_like(target, torch.inf)
    highest = torch.where(mask, target, -infinity).amax((2, 3), keepdim=True)
    lowest = torch.where(mask, target, infinity).amin((2, 3), keepdim=True)
    change = target[:, 1:] - target[:, :-1]
    keep = mask[:, 1:] & mask[:, :-1] & (change.abs() < steady * (highest - lowest)[:, 1:])
    error = (fitted[:, 1:] - fitted[:, :-1] - change).abs()
    return torch.where(keep, error, torch.zeros_like(error)).sum() / keep.sum().clamp_min(1)


def _fitted(
    prediction: Float[Tensor, "b t h w"], target: Float[Tensor, "b t h w"], mask: Bool[Tensor, "b t h w"]
) -> Float[Tensor, "b t h w"]:
    """The prediction after the scale and shift of each clip that fit the target best in least squares."""
    x, y, m = prediction.flatten(1), target.flatten(1), mask.flatten(1).float()
    n, sx, sy = m.sum(1), (m * x).sum(1), (m * y).sum(1)
    sxx, sxy = (m * x * x).sum(1), (m * x * y).sum(1)
    determinant = n * sxx - sx * sx
    solvable = determinant != 0
    safe = torch.where(solvable, determinant, torch.ones_like(determinant))
    scale = torch.where(solvable, (n * sxy - sx * sy) / safe, torch.zeros_like(safe))
    shift = torch.where(solvable, (sxx * sy - sx * sxy) / safe, torch.zeros_like(safe))
    return scale[:, None, None, None] * prediction + shift[:, None, None, None]

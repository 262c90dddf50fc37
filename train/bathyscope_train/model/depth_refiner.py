"""Depth from several views: what parallax says about the depth of one view, spread over the image by a small network.

A point of known direction and unknown depth, seen again from a camera that moved, has one free number: its depth. Each
match gives one weighted least-squares step for the logarithm of it; the steps of all pairs that start in a frame add
up. Matches are sparse, and where nothing moves sideways they say nothing, so the network reads step and certainty and
says by which smooth field the depth is to be multiplied. It begins as "by one".
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.correspondence import QUERY_STEP
from bathyscope_train.model.pose_layer import NOISE_FLOOR, Motion, linearise
from bathyscope_train.model.stem import CELL, ResidualConv

_LARGEST_STEP = 1.0
_LARGEST_CORRECTION = 1.5
_INPUTS = 6  # step, certainty, logarithm of certainty, logarithm of depth, place


def parallax(
    points: Float[Tensor, "e q 3"],
    matches: Float[Tensor, "e q 2"],
    trust: Float[Tensor, "e q 2"],
    focal: Float[Tensor, "e"],
    motion: Motion,
) -> tuple[Float[Tensor, "e q"], Float[Tensor, "e q"]]:
    """Gradient and curvature of each match's squared residual by the logarithm of the point's depth.

    Both are divided by the pair's residual variance, so those of several pairs may be added.

    Args:
        points: The queries in the source camera.
        matches: Where they were seen in the target frame, in cells from the principal point.
        trust: Weights of the matches.
        focal: Focal length in cells.
        motion: Target-from-source motions.
    """
    line = linearise(points, matches, trust, focal, motion)
    turned = points @ motion.rotation.transpose(-1, -2)
    change = (line.by_point @ turned[..., None])[..., 0]
    residual = line.residual.unflatten(1, (-1, 2))
    scale = (1 / (line.variance + NOISE_FLOOR))[:, None]
    return (trust * change * residual).sum(-1) * scale, (trust * change.square()).sum(-1) * scale


class DepthRefiner(nn.Module):
    """Correction of the logarithm of depth at the queries of each frame.

    Args:
        context: Channels of the queries' features.
        width: Channels of the network.
    """

    def __init__(self, context: int, width: int = 48) -> None:
        super().__init__()
        self.enter = nn.Conv2d(context + _INPUTS, width, 3, padding=1)
        self.blocks = nn.Sequential(*(ResidualConv(width, dilation=dilation) for dilation in (1, 2, 4, 1)))
        self.readout = nn.Conv2d(width, 1, 3, padding=1)
        nn.init.zeros_(self.readout.weight)
        assert self.readout.bias is not None
        nn.init.zeros_(self.readout.bias)

    def forward(
        self,
        gradient: Float[Tensor, "b t q"],
        curvature: Float[Tensor, "b t q"],
        log_depth: Float[Tensor, "b t q"],
        position: Float[Tensor, "q 2"],
        context: Float[Tensor, "b t k qh qw"],
    ) -> Float[Tensor, "b t q"]:
        """Addition to the logarithm of depth at each query.

        Args:
            gradient: Sum over the pairs that start in the frame, from :func:`parallax`.
            curvature: Likewise.
            log_depth: Logarithm of the depth that is to be corrected, in units of the clip's mean.
            position: Where the queries are in the image, about -1 to 1.
            context: Their features.
        """
        b, t = log_depth.shape[:2]
        step = (gradient / (curvature + 1)).clamp(-_LARGEST_STEP, _LARGEST_STEP)
        certainty = curvature / (curvature + 1)
        channels = torch.stack([step, certainty, (1 + curvature).log() / 4, log_depth], 2)
        place = position.transpose(0, 1).expand(b, t, 2, position.shape[0])
        grid = (context.shape[-2], context.shape[-1])
        maps = torch.cat([torch.cat([channels, place], 2).unflatten(-1, grid), context], 2).flatten(0, 1)
        correction: Tensor = self.readout(F.relu(self.blocks(self.enter(maps))))
        limited: Tensor = _LARGEST_CORRECTION * torch.tanh(correction / _LARGEST_CORRECTION)
        per_query: Tensor = limited.flatten(1).unflatten(0, (b, t))
        return per_query


def spread_queries(values: Float[Tensor, "n qh qw"], like: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """Values at the queries, bilinear in between, constant beyond the outermost, at every pixel of ``like``."""
    rows = _sample_positions(like.shape[-2], values.shape[-2], like)
    columns = _sample_positions(like.shape[-1], values.shape[-1], like)
    size = (rows.shape[0], columns.shape[0])
    grid = torch.stack([columns[None, :].expand(size), rows[:, None].expand(size)], -1)
    sampled = F.grid_sample(
        values[:, None], grid[None].expand(values.shape[0], -1, -1, -1), padding_mode="border", align_corners=True
    )
    return sampled[:, 0]


def _sample_positions(pixels: int, queries: int, like: Tensor) -> Float[Tensor, "n"]:
    """Where the centres of pixels lie on a line of queries whose first is -1 and last is 1."""
    step = CELL * QUERY_STEP
    first = CELL / 2
    centres = torch.arange(pixels, device=like.device, dtype=like.dtype) + 0.5
    last = torch.full((), queries, device=like.device, dtype=like.dtype) - 1
    return 2 * (centres - first) / (step * last.clamp_min(0.5)) - 1

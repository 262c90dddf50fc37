"""Supervised correspondences: where a point of one frame truly appears in another."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.data.windows import Batch
from bathyscope_train.losses.depth import masked_mean
from bathyscope_train.model.correspondence import Correlation, query_centres, query_depth
from bathyscope_train.model.pose_layer import NEAREST, Motion, carry, project, rays
from bathyscope_train.model.rigid import relative_motion
from bathyscope_train.model.stem import CELL
from bathyscope_train.model.trajectory import ClipPairs

_SAME_SURFACE = 0.06
_LARGEST_FLOW_ERROR = 20.0
_CERTAIN_REACH = 9.5
_NEWTON_STEPS = 8


@dataclass(frozen=True, slots=True)
class TrueMatches:
    """Ground truth for the queries of e pairs; lengths in cells, positions from the principal point."""

    motion: Motion
    points: Float[Tensor, "e q 3"]
    """The queries in the source camera, from true depth."""
    focal: Float[Tensor, "e"]
    queries: Float[Tensor, "q 2"]
    positions: Float[Tensor, "e q 2"]
    """Where they appear in the target frame."""
    ideal: Float[Tensor, "e q 2"]
    """Where they would appear without the lens's distortion."""
    visible: Bool[Tensor, "e q"]
    """Inside the target frame and not hidden there: its depth agrees within 6 %, and nothing moves by itself."""


def true_matches(batch: Batch, pairs: ClipPairs) -> TrueMatches:
    """True matches of p pairs of frames of each clip (e = b p, clip-major).

    Args:
        batch: Windows with true depth, poses, focal length, distortion and what moves by itself.
        pairs: What is matched.
    """
    source, target = pairs.source, pairs.target
    depth = batch.depth
    height, width = depth.shape[-2:]
    count = source.shape[0]
    cells = (batch.focal / CELL)[:, None].expand(-1, count).flatten()
    bend = batch.distortion[:, None].expand(-1, count, 2).flatten(0, 1)
    principal = depth.new_tensor([width, height]) / (2 * CELL)
    queries = query_centres(-(-height // CELL), -(-width // CELL), like=depth) - principal
    distance = query_depth(depth)[:, source].flatten(0, 1)
    shown = undistort(queries / cells[:, None, None], bend) * cells[:, None, None]
    points = rays(shown, cells[:, None].expand(distance.shape)) * distance[..., None]
    motion = Motion(*(part.flatten(0, 1) for part in relative_motion(batch.world_from_camera, source, target)))
    ideal = project(points, motion, cells)
    positions = distort(ideal / cells[:, None, None], bend) * cells[:, None, None]
    labels = torch.stack([depth, batch.moving.to(depth.dtype)], 2)[:, target].flatten(0, 1)
    seen = F.grid_sample(labels, (positions / principal)[:, None], mode="nearest", align_corners=False)[:, :, 0]
    expected = carry(points, motion)[..., 2]
    inside = (positions.abs() < principal).all(-1)
    same = (seen[:, 0] / expected - 1).abs() < _SAME_SURFACE
    still = (query_depth(batch.moving.to(depth.dtype))[:, source].flatten(0, 1) == 0) & (seen[:, 1] == 0)
    visible = inside & same & still & (distance > 0) & (expected > NEAREST)
    return TrueMatches(motion, points, cells, queries, positions, ideal, visible)


def distort(points: Float[Tensor, "e q 2"], bend: Float[Tensor, "e 2"]) -> Float[Tensor, "e q 2"]:
    """Where a lens with radial distortion ``bend`` = (k1, k2) shows normalised points."""
    square = points.square().sum(-1, keepdim=True)
    return points * (1 + square * (bend[:, None, :1] + bend[:, None, 1:] * square))


def undistort(points: Float[Tensor, "e q 2"], bend: Float[Tensor, "e 2"]) -> Float[Tensor, "e q 2"]:
    """The inverse of :func:`distort`, by Newton's iteration on the radius."""
    radius = points.square().sum(-1, keepdim=True).sqrt()
    bare, k1, k2 = radius, bend[:, None, :1], bend[:, None, 1:]
    for _ in range(_NEWTON_STEPS):
        square = bare.square()
        bare = bare - (bare * (1 + square * (k1 + k2 * square)) - radius) / (1 + square * (3 * k1 + 5 * k2 * square))
    return points * bare / radius.clamp_min(1e-9)


def matching_cross_entropy(
    correlation: Correlation, true: TrueMatches, principal: Float[Tensor, "2"]
) -> Float[Tensor, ""]:
    """Cross-entropy of the similarities; the label is spread over the four cells around the true position.

    Counts visible points that move less than 9.5 cells along both axes.
    """
    logits = correlation.logits
    e, q, gh, gw = logits.shape
    position = true.positions + principal
    size = position.new_tensor([gw, gh])
    grid = (2 * position / size - 1).reshape(e * q, 1, 1, 2)
    label = F.grid_sample(logits.reshape(e * q, 1, gh, gw), grid, align_corners=False).reshape(e, q)
    near = (true.positions - true.queries).abs().amax(-1) < _CERTAIN_REACH
    return masked_mean(correlation.normaliser - label, true.visible & near)


def flow_loss(matches: Float[Tensor, "e q 2"], true: TrueMatches) -> Float[Tensor, ""]:
    """Mean distance (L1, at most 20 cells) of matches from the true positions, over visible points."""
    error = (matches - true.positions).abs().sum(-1).clamp_max(_LARGEST_FLOW_ERROR)
    return masked_mean(error, true.visible)

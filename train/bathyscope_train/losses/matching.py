"""Supervised correspondences: where a point of one frame truly appears in another."""

from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bathyscope_train.losses.depth import masked_mean
from bathyscope_train.model.correspondence import Correlation, query_centres, query_depth
from bathyscope_train.model.pose_layer import NEAREST, Motion, carry, project, rays
from bathyscope_train.model.rigid import relative_motion
from bathyscope_train.model.stem import CELL

_SAME_SURFACE = 0.06
_LARGEST_FLOW_ERROR = 20.0
_CERTAIN_REACH = 9.5


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
    visible: Bool[Tensor, "e q"]
    """Inside the target frame and not hidden there: its depth agrees within 6 %."""


def true_matches(
    depth: Float[Tensor, "b t h w"],
    world_from_camera: Float[Tensor, "b t 4 4"],
    focal: Float[Tensor, "b"],
    source: Int[Tensor, "p"],
    target: Int[Tensor, "p"],
) -> TrueMatches:
    """True matches of p pairs of frames of each clip (e = b p, clip-major).

    Args:
        depth: True depth, 0 where unknown; the unit of the poses.
        world_from_camera: True poses.
        focal: Focal length in pixels; the principal point is the centre of the image.
        source: Frames that the matches start from.
        target: Frames in which they are sought.
    """
    height, width = depth.shape[-2:]
    pairs = source.shape[0]
    cells = (focal / CELL)[:, None].expand(-1, pairs).flatten()
    principal = depth.new_tensor([width, height]) / (2 * CELL)
    queries = query_centres(-(-height // CELL), -(-width // CELL), like=depth) - principal
    distance = query_depth(depth)[:, source].flatten(0, 1)
    points = rays(queries.expand(*distance.shape, 2), cells[:, None].expand(distance.shape)) * distance[..., None]
    motion = Motion(*(part.flatten(0, 1) for part in relative_motion(world_from_camera, source, target)))
    positions = project(points, motion, cells)
    normalised = (positions / principal)[:, None]
    seen = F.grid_sample(depth[:, target].flatten(0, 1)[:, None], normalised, mode="nearest", align_corners=False)
    expected = carry(points, motion)[..., 2]
    inside = (positions.abs() < principal).all(-1)
    same = (seen[:, 0, 0] / expected - 1).abs() < _SAME_SURFACE
    visible = inside & same & (distance > 0) & (expected > NEAREST)
    return TrueMatches(motion, points, cells, queries, positions, visible)


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

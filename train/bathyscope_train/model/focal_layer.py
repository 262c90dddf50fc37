"""Focal length of a clip from its motions: one shared unknown beside the motion of every pair.

A wrong focal length bends the flow of a turning camera in a way that no motion explains. Eliminating the motion from a
pair's normal equations leaves how much its matches ask for another focal length, and how sure of it they are. The
clip's correction is the sum over its pairs, held back by the trust in the first estimate. A camera that hardly
turns says nothing, and the estimate stays.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.pose_layer import NOISE_FLOOR, Motion, damped, linearise, rays, solve_columns

_LARGEST_STEP = 0.4


def focal_step(
    queries: Float[Tensor, "q 2"],
    depth: Float[Tensor, "e q"],
    matches: Float[Tensor, "e q 2"],
    trust: Float[Tensor, "e q 2"],
    *,
    focal: Float[Tensor, "e"],
    motion: Motion,
) -> tuple[Float[Tensor, "e"], Float[Tensor, "e"]]:
    """Gradient and curvature of each pair's squared residuals by the logarithm of the focal length.

    Args:
        queries: Positions in the source frame, in cells from the principal point.
        depth: Their depth.
        matches: Where they were seen in the target frame.
        trust: Weights of the matches.
        focal: Focal length in cells.
        motion: Target-from-source motions, which are free to follow the focal length.
    """
    points = rays(queries.expand(*depth.shape, 2), focal[:, None].expand(depth.shape)) * depth[..., None]
    line = linearise(points, matches, trust, focal, motion)
    # The projection is proportional to the focal length, and the point itself moves: its sideways position is
    # depth * query / focal.
    sideways = points * points.new_tensor((1.0, 1.0, 0.0))
    change = sideways @ motion.rotation.transpose(-1, -2)
    position = focal[:, None, None] * line.moved[..., :2] / line.moved[..., 2:]
    column = (position - (line.by_point @ change[..., None])[..., 0]).flatten(1)
    count = depth.shape[1]
    weighted = (line.jacobian * line.weights[..., None]).transpose(-1, -2)
    matrix = damped(weighted @ line.jacobian / count)
    shared = weighted @ torch.stack([column, line.residual], -1) / count
    solved = solve_columns(matrix, shared)
    curvature = (line.weights * column.square()).sum(-1) / count - (shared[..., 0] * solved[..., 0]).sum(-1)
    gradient = (line.weights * column * line.residual).sum(-1) / count - (shared[..., 0] * solved[..., 1]).sum(-1)
    scale = 1 / (line.variance + NOISE_FLOOR)
    return gradient * scale, curvature.clamp_min(0) * scale


def fuse_focal(
    gradient: Float[Tensor, "b e"],
    curvature: Float[Tensor, "b e"],
    shift: Float[Tensor, "b"],
    prior: Float[Tensor, ""],
) -> Float[Tensor, "b"]:
    """Change of the logarithm of the focal length that suits all pairs of a clip.

    Args:
        gradient: From :func:`focal_step`; 0 for pairs that do not count.
        curvature: Likewise.
        shift: How far the logarithm is from the first estimate already.
        prior: Trust in the first estimate, as an inverse variance.
    """
    step = (gradient.sum(1) - prior * shift) / (curvature.sum(1) + prior)
    return step.clamp(-_LARGEST_STEP, _LARGEST_STEP)

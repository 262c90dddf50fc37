"""Camera motion from matches and depth: a differentiable, weighted Gauss-Newton solver.

The layer has no parameters. A point of the source camera with known depth is carried into the target
camera and projected; the distance to where the matcher saw it is a residual in *cells* (the matcher's unit
of length, 4 px). Three unrolled, damped iterations minimise the weighted squares. Where the weights are
small the damping wins and the answer is "no motion".
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.rigid import rotate, rotation_exponential

NEAREST = 0.05
"""Smallest depth behind which a projection is cut off, in units of the clip's mean depth."""

_RELATIVE_DAMPING = 1e-3
_ABSOLUTE_DAMPING = 1e-2
_LARGEST_UPDATE = 1.0
_NOISE_FLOOR = 0.02


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion from source to target cameras; depth and translation share one unit, about the mean depth."""

    rotation: Float[Tensor, "*b 3 3"]
    translation: Float[Tensor, "*b 3"]

    @staticmethod
    def none(like: Float[Tensor, "*b 3"]) -> "Motion":
        """The identity, with the batch shape, type and device of a translation."""
        identity = torch.eye(3, dtype=like.dtype, device=like.device)
        return Motion(identity + torch.zeros_like(like)[..., None], torch.zeros_like(like))

    def detach(self) -> "Motion":
        """The same motion, cut off from the gradient."""
        return Motion(self.rotation.detach(), self.translation.detach())


@dataclass(frozen=True, slots=True)
class Solution:
    """What the solver found."""

    motion: Motion
    information: Float[Tensor, "*b 6 6"]
    """Normal matrix over residual variance, for (translation, rotation): how far each pair may be trusted."""


def rays(cells: Float[Tensor, "*b 2"], focal: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3"]:
    """Viewing rays with z = 1 of positions relative to the principal point, in cells."""
    scaled = cells / focal[..., None]
    return torch.cat([scaled, torch.ones_like(scaled[..., :1])], -1)


def carry(points: Float[Tensor, "e n 3"], motion: Motion) -> Float[Tensor, "e n 3"]:
    """Points of the source camera in the target camera, not nearer than :data:`NEAREST`."""
    moved = points @ motion.rotation.transpose(-1, -2) + motion.translation[:, None]
    return torch.cat([moved[..., :2], moved[..., 2:].clamp_min(NEAREST)], -1)


def project(points: Float[Tensor, "e n 3"], motion: Motion, focal: Float[Tensor, "e"]) -> Float[Tensor, "e n 2"]:
    """Where points of the source camera appear in the target camera, in cells from the principal point."""
    moved = carry(points, motion)
    return focal[:, None, None] * moved[..., :2] / moved[..., 2:]


def solve_motion(
    points: Float[Tensor, "e n 3"],
    target: Float[Tensor, "e n 2"],
    weights: Float[Tensor, "e n 2"],
    focal: Float[Tensor, "e"],
    start: Motion,
    *,
    iterations: int = 3,
) -> Solution:
    """Weighted least-squares motion of each pair, by unrolled Gauss-Newton.

    Args:
        points: Points in the source camera; depth about 1 (clip mean).
        target: Where they were seen in the target camera, in cells from the principal point.
        weights: Trust in each coordinate of ``target``, 0 to 1.
        focal: Focal length in cells.
        start: First guess.
        iterations: How often the system is linearised and solved.
    """
    motion = start
    for _ in range(iterations):
        matrix, vector, _ = _normal_equations(points, target, weights, focal, motion)
        damping = _RELATIVE_DAMPING * matrix * torch.eye(6, dtype=matrix.dtype, device=matrix.device)
        damping = damping + _ABSOLUTE_DAMPING * torch.eye(6, dtype=matrix.dtype, device=matrix.device)
        update = solve_positive(matrix + damping, vector).clamp(-_LARGEST_UPDATE, _LARGEST_UPDATE)
        turn = rotation_exponential(update[..., 3:])
        motion = Motion(turn @ motion.rotation, rotate(turn, motion.translation) + update[..., :3])
    matrix, _, variance = _normal_equations(points, target, weights, focal, motion)
    return Solution(motion, matrix / (variance + _NOISE_FLOOR)[:, None, None])


def _normal_equations(
    points: Tensor, target: Tensor, weights: Tensor, focal: Tensor, motion: Motion
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"], Float[Tensor, "e"]]:
    """Normal matrix and vector (means over the points) and weighted mean squared residual of each pair."""
    moved = carry(points, motion)
    inverse = 1 / moved[..., 2]
    x, y = moved[..., 0] * inverse, moved[..., 1] * inverse
    residual = target - focal[:, None, None] * torch.stack([x, y], -1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    row_u = torch.stack([inverse, zero, -x * inverse, -x * y, one + x * x, -y], -1)
    row_v = torch.stack([zero, inverse, -y * inverse, -one - y * y, x * y, x], -1)
    jacobian = focal[:, None, None] * torch.cat([row_u, row_v], 1)
    flat_weights = torch.cat([weights[..., 0], weights[..., 1]], 1)
    flat_residual = torch.cat([residual[..., 0], residual[..., 1]], 1)
    count = points.shape[1]
    weighted = (jacobian * flat_weights[..., None]).transpose(-1, -2)
    matrix = weighted @ jacobian / count
    vector = (weighted @ flat_residual[..., None])[..., 0] / count
    variance = (flat_weights * flat_residual.square()).sum(-1) / (flat_weights.sum(-1) + 1e-6)
    return matrix, vector, variance


def solve_positive(matrix: Float[Tensor, "*b n n"], vector: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n"]:
    """Solve a small symmetric positive definite system by Gauss-Jordan elimination without pivoting.

    Unrolled over the (static) size, because graph run-times have no linear solver.
    """
    size = matrix.shape[-1]
    rows = torch.cat([matrix, vector[..., None]], -1)
    identity = torch.eye(size, dtype=rows.dtype, device=rows.device)
    for pivot in range(size):
        scaled = rows[..., pivot : pivot + 1, :] / rows[..., pivot : pivot + 1, pivot : pivot + 1]
        unit = identity[:, pivot : pivot + 1]
        # Row p becomes the scaled pivot row; every other row loses its multiple of it.
        rows = rows * (1 - unit) - (rows[..., pivot : pivot + 1] * (1 - unit) - unit) * scaled
    return rows[..., -1]

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

from bathyscope_train.model.rigid import cross_matrix, rotate, rotation_exponential, rotation_logarithm

NEAREST = 0.05
"""Smallest depth behind which a projection is cut off, in units of the clip's mean depth."""

NOISE_FLOOR = 0.02
"""Variance of a match that no agreement of its pair can undercut, in cells^2."""

_RELATIVE_DAMPING = 1e-3
_ABSOLUTE_DAMPING = 1e-2
_LARGEST_UPDATE = 1.0
_SMALLEST_FLOW = 1e-4  # cells^2
_LARGEST_HOLD = 0.1


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
    variance: Float[Tensor, "*b"]
    """Weighted mean squared residual, cells^2."""


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
    flow_noise: float = 0.0,
) -> Solution:
    """Weighted least-squares motion of each pair, by unrolled Gauss-Newton.

    Turning and moving sideways look alike where there is little relief, and on slow video the noise of the matches
    decides between them: large parts that cancel in the picture. ``flow_noise`` holds every part of a motion back by as
    much as its own flow would exceed what was seen: nothing where much moves, noticeably where hardly anything does.

    Args:
        points: Points in the source camera; depth about 1 (clip mean).
        target: Where they were seen in the target camera, in cells from the principal point.
        weights: Trust in each coordinate of ``target``, 0 to 1.
        focal: Focal length in cells.
        start: First guess.
        iterations: How often the system is linearised and solved.
        flow_noise: Variance, in cells^2, against the mean squared flow of a pair; 0 holds nothing back.
    """
    motion = start
    hold = None if flow_noise == 0 else flow_noise / _mean_squared_flow(points, target, weights, focal)
    for _ in range(iterations):
        matrix, vector, _ = _normal_equations(points, target, weights, focal, motion)
        if hold is not None:
            matrix, vector = _held_back(matrix, vector, motion, hold)
        update = solve_positive(damped(matrix), vector).clamp(-_LARGEST_UPDATE, _LARGEST_UPDATE)
        turn = rotation_exponential(update[..., 3:])
        motion = Motion(turn @ motion.rotation, rotate(turn, motion.translation) + update[..., :3])
    matrix, _, variance = _normal_equations(points, target, weights, focal, motion)
    return Solution(motion, matrix / (variance + NOISE_FLOOR)[:, None, None], variance)


def _mean_squared_flow(
    points: Float[Tensor, "e n 3"],
    target: Float[Tensor, "e n 2"],
    weights: Float[Tensor, "e n 2"],
    focal: Float[Tensor, "e"],
) -> Float[Tensor, "e"]:
    """Weighted mean squared distance of the matches from where their points were, cells^2; without a gradient."""
    flow = target - focal[:, None, None] * points[..., :2] / points[..., 2:]
    mean = (weights * flow.square()).sum((-2, -1)) / (weights.sum((-2, -1)) + 1e-6)
    return (mean + _SMALLEST_FLOW).detach()


def _held_back(
    matrix: Float[Tensor, "e 6 6"], vector: Float[Tensor, "e 6"], motion: Motion, hold: Float[Tensor, "e"]
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"]]:
    """Normal equations with a prior for no motion, whose precision is a share of the matrix's own diagonal."""
    identity = torch.eye(6, dtype=matrix.dtype, device=matrix.device)
    prior = (matrix * identity).sum(-1) * hold.clamp_max(_LARGEST_HOLD)[:, None]
    so_far = torch.cat([motion.translation, rotation_logarithm(motion.rotation)], -1)
    return matrix + prior[..., None] * identity, vector - prior * so_far


@dataclass(frozen=True, slots=True)
class Linearised:
    """Projections of n points of each pair and how they change; x and y of each point follow each other."""

    moved: Float[Tensor, "e n 3"]
    """The points in the target camera."""
    by_point: Float[Tensor, "e n 2 3"]
    """Derivative of the projection by the moved point."""
    residual: Float[Tensor, "e m"]
    """Measured minus projected, in cells; m = 2 n."""
    jacobian: Float[Tensor, "e m 6"]
    """Derivative of the projection by a small motion (translation, rotation) from the left."""
    weights: Float[Tensor, "e m"]

    @property
    def variance(self) -> Float[Tensor, "e"]:
        """Weighted mean squared residual, cells^2."""
        return (self.weights * self.residual.square()).sum(-1) / (self.weights.sum(-1) + 1e-6)


def linearise(
    points: Float[Tensor, "e n 3"],
    target: Float[Tensor, "e n 2"],
    weights: Float[Tensor, "e n 2"],
    focal: Float[Tensor, "e"],
    motion: Motion,
) -> Linearised:
    """The projections of the points under a motion, to first order."""
    moved = carry(points, motion)
    depth = moved[..., 2:]
    position = moved[..., :2] / depth
    scale = focal[:, None, None]
    # d (Y_x / Y_z, Y_y / Y_z) / d Y = (1, 0, -x; 0, 1, -y) / Y_z
    plane, axis = moved.new_tensor(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))), moved.new_tensor((0.0, 0.0, 1.0))
    by_point = (plane - position[..., None] * axis) * (scale / depth)[..., None]
    by_motion = torch.cat([by_point, -by_point @ cross_matrix(moved)], -1)
    residual = (target - scale * position).flatten(1)
    return Linearised(moved, by_point, residual, by_motion.flatten(1, 2), weights.flatten(1))


def _normal_equations(
    points: Tensor, target: Tensor, weights: Tensor, focal: Tensor, motion: Motion
) -> tuple[Float[Tensor, "e 6 6"], Float[Tensor, "e 6"], Float[Tensor, "e"]]:
    """Normal matrix and vector (means over the points) and weighted mean squared residual of each pair."""
    line = linearise(points, target, weights, focal, motion)
    count = points.shape[1]
    weighted = (line.jacobian * line.weights[..., None]).transpose(-1, -2)
    matrix = weighted @ line.jacobian / count
    vector = (weighted @ line.residual[..., None])[..., 0] / count
    return matrix, vector, line.variance


def damped(matrix: Float[Tensor, "*b n n"]) -> Float[Tensor, "*b n n"]:
    """A normal matrix that can be inverted: a little more of its diagonal, and a constant that stands for no motion."""
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return matrix + _RELATIVE_DAMPING * matrix * identity + _ABSOLUTE_DAMPING * identity


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


def solve_columns(matrix: Float[Tensor, "*b n n"], columns: Float[Tensor, "*b n k"]) -> Float[Tensor, "*b n k"]:
    """``matrix^-1 columns`` for a small symmetric positive definite matrix."""
    size, count = matrix.shape[-1], columns.shape[-1]
    repeated = matrix[..., None, :, :].expand(*matrix.shape[:-2], count, size, size)
    return solve_positive(repeated, columns.transpose(-1, -2)).transpose(-1, -2)

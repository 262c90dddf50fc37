"""All measured motions of a clip at once: a weighted least-squares correction of its trajectory.

With small motions ``x_k`` from the left of the camera-from-first-camera motions ``T_k``, a measured motion ``M`` from
frame i to frame j disagrees by ``d + A x_i - x_j``, where ``d`` takes ``T_j`` to ``M T_i`` and ``A`` is the adjoint of
``M``. The sum of the squares, weighted by information, is least at the solution of one symmetric positive definite
system in all ``x``. It is solved by conjugate gradients with the inverse of its diagonal blocks as preconditioner and
a fixed number of steps, each of which lowers the sum: the graph has no loop and any number of frames.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.pose_layer import Motion, solve_columns
from bathyscope_train.model.rigid import adjoint, compose, rotate
from bathyscope_train.model.trajectory import ClipPairs, difference, move

_HOLD = 1e-3
_LEAST = 1e-20  # a clamp and not an addition: graph optimisers drop those


def settle_trajectory(
    trajectory: Motion, measured: Motion, information: Float[Tensor, "b e 6 6"], pairs: ClipPairs, *, count: int = 8
) -> Motion:
    """The trajectory that agrees best with all measured motions; frame 0 stays the identity.

    A pair whose motion disagrees by more than its own uncertainty counts less (Cauchy weights), because a loop may
    join frames that see nothing in common.

    Args:
        trajectory: First guess, (b, t, ...), close enough to be linearised about.
        measured: Target-from-source motions, (b, e, ...).
        information: Inverse covariance of each, for (translation, rotation vector) from the left.
        pairs: What was measured.
        count: Steps of the solver.
    """
    frames = trajectory.translation.shape[1]
    index = torch.arange(frames, device=information.device)
    starts = (index[:, None] == pairs.source[None]).to(information.dtype)
    ends = (index[:, None] == pairs.target[None]).to(information.dtype)
    free = (index > 0).to(information.dtype)[:, None]

    base = Motion(trajectory.rotation[:, pairs.target], trajectory.translation[:, pairs.target])
    begin = (trajectory.rotation[:, pairs.source], trajectory.translation[:, pairs.source])
    reached = Motion(*compose((measured.rotation, measured.translation), begin))
    offset = difference(reached, base)
    surprise = (offset * rotate(information, offset)).sum(-1)
    weight = information * (pairs.inside / (1 + surprise))[..., None, None]
    carried = adjoint(measured.rotation, measured.translation)
    back = carried.transpose(-1, -2)

    def gather(per_pair: Float[Tensor, "b e 6"]) -> Float[Tensor, "b t 6"]:
        """Transpose of the disagreement: from pairs to frames."""
        weighted = rotate(weight, per_pair)
        return free * (starts @ rotate(back, weighted) - ends @ weighted)

    def apply(steps: Float[Tensor, "b t 6"]) -> Float[Tensor, "b t 6"]:
        disagreement = rotate(carried, steps[:, pairs.source]) - steps[:, pairs.target]
        return gather(disagreement) + _HOLD * steps

    blocks = starts @ (back @ weight @ carried).flatten(-2) + ends @ weight.flatten(-2)
    identity = torch.eye(6, dtype=weight.dtype, device=weight.device)
    blocks = blocks.unflatten(-1, (6, 6)) + _HOLD * identity
    preconditioner = solve_columns(blocks, identity.expand(blocks.shape))

    steps = torch.zeros_like(gather(offset))
    residual = -gather(offset)
    scaled = rotate(preconditioner, residual)
    direction, energy = scaled, (residual * scaled).sum((1, 2), keepdim=True)
    for _ in range(count):
        image = apply(direction)
        length = energy / (direction * image).sum((1, 2), keepdim=True).clamp_min(_LEAST)
        steps, residual = steps + length * direction, residual - length * image
        scaled = rotate(preconditioner, residual)
        updated = (residual * scaled).sum((1, 2), keepdim=True)
        direction = scaled + updated / energy.clamp_min(_LEAST) * direction
        energy = updated
    return move(steps, trajectory)

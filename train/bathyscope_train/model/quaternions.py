"""Quaternions in the project's own order, (w, x, y, z)."""

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.pose_encoding import matrix_to_quaternion


def quaternion_from_rotation(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix."""
    return matrix_to_quaternion(rotation).roll(1, dims=-1)


def multiply(left: Float[Tensor, "*b 4"], right: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product: the rotation ``right``, then ``left``."""
    w, x, y, z = left.unbind(-1)
    a, b, c, d = right.unbind(-1)
    return torch.stack(
        (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ),
        dim=-1,
    )

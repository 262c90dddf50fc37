"""Rigid motions as rotation matrices and translations: exponential, logarithm, composition, adjoint.

A motion is a pair (rotation (..., 3, 3), translation (..., 3)) that maps ``x`` to ``R x + t``. Everything
here is made of plain products, so that it exports as standard graph nodes at any batch shape.
"""

import torch
from jaxtyping import Float
from torch import Tensor

_CROSS = (
    (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
)
"""Cross matrix of each unit vector, row by row."""

_EPSILON = 1e-7  # ONNX graph optimisers take an addition of 1e-8 for one of nothing and drop it


def cross_matrix(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix that takes the cross product with ``vector`` from the left."""
    # One product with a constant: taken apart and stacked, it would be a score of graph nodes, and it is everywhere.
    matrix: Tensor = (vector @ vector.new_tensor(_CROSS)).unflatten(-1, (3, 3))
    return matrix


def rotation_exponential(angles: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation about ``angles`` by its length, in radians (Rodrigues).

    The squared length gets 1e-7 added, which keeps the gradient finite at zero and costs less than 1e-7
    in the result.
    """
    theta = (angles.square().sum(-1, keepdim=True) + _EPSILON).sqrt()[..., None]
    cross = cross_matrix(angles)
    identity = torch.eye(3, dtype=angles.dtype, device=angles.device)
    return identity + torch.sin(theta) / theta * cross + (1 - torch.cos(theta)) / theta.square() * (cross @ cross)


def rotation_logarithm(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector of ``rotation``; accurate below about 3 radians, which differences of cameras are."""
    vector = antisymmetric_part(rotation)
    sine = (vector.square().sum(-1, keepdim=True) + _EPSILON).sqrt()
    cosine = (trace(rotation)[..., None] - 1) / 2
    return vector * torch.atan2(sine, cosine) / sine


def antisymmetric_part(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """The vector of the antisymmetric half of a matrix: axis times sine of the angle for a rotation."""
    return 0.5 * rotation.flatten(-2) @ rotation.new_tensor(_CROSS).transpose(0, 1)


def trace(matrix: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Sum of the diagonal."""
    return (matrix * torch.eye(3, dtype=matrix.dtype, device=matrix.device)).sum((-2, -1))


def rotate(rotation: Float[Tensor, "*b 3 3"], vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Product of a matrix and a vector."""
    return (rotation @ vector[..., None])[..., 0]


def compose(
    outer: tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]],
    inner: tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]],
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """The motion ``inner``, then ``outer``."""
    return outer[0] @ inner[0], rotate(outer[0], inner[1]) + outer[1]


def inverse(
    motion: tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]],
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    """The motion that undoes ``motion``."""
    back = motion[0].transpose(-1, -2)
    return back, -rotate(back, motion[1])


def adjoint(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 6 6"]:
    """Carries a small motion (translation, rotation vector) from before a motion to after it.

    ``T exp(d) = exp(adjoint(T) d) T`` with ``exp(d)`` the small motion with translation ``d[:3]`` and
    rotation vector ``d[3:]``, to first order.
    """
    top = torch.cat([rotation, cross_matrix(translation) @ rotation], -1)
    bottom = torch.cat([torch.zeros_like(rotation), rotation], -1)
    return torch.cat([top, bottom], -2)


def relative_motion(
    world_from_camera: Float[Tensor, "*b t 4 4"], source: Tensor, target: Tensor
) -> tuple[Float[Tensor, "*b e 3 3"], Float[Tensor, "*b e 3"]]:
    """Motion that maps points of the ``source`` cameras into the ``target`` cameras, for e pairs of frames."""
    first, second = world_from_camera[..., source, :, :], world_from_camera[..., target, :, :]
    second_rotation = second[..., :3, :3].transpose(-1, -2)
    translation = rotate(second_rotation, first[..., :3, 3] - second[..., :3, 3])
    return second_rotation @ first[..., :3, :3], translation

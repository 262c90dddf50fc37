"""The nine numbers a camera head speaks: translation, quaternion, two fields of view ("absT_quaR_FoV").

``[tx ty tz | qx qy qz qw | fov_h fov_w]``: camera-from-world, quaternion scalar last and of any length, then the
vertical field of view and the horizontal one, in radians.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_SAFE_SQUARE = 1e-30


class Cameras(NamedTuple):
    """Decoded cameras."""

    camera_from_world: Float[Tensor, "*b 4 4"]
    intrinsics: Float[Tensor, "*b 3 3"]
    """In pixels of the stated size; the principal point is the centre of the image."""


def decode_cameras(encoding: Float[Tensor, "*b 9"], size: tuple[int, int], *, focal_epsilon: float = 0.0) -> Cameras:
    """Cameras from their encodings, for images of ``size`` (height, width).

    ``focal_epsilon`` is added to tan(fov / 2): 1e-3 in AnySplat (so that no field of view gives an infinite focal
    length), 0 in VGGT.
    """
    rotation = quaternion_to_matrix(encoding[..., 3:7])
    top = torch.cat((rotation, encoding[..., :3, None]), dim=-1)
    bottom = torch.zeros_like(top[..., :1, :]) + top.new_tensor((0.0, 0.0, 0.0, 1.0))
    height, width = size
    halves = torch.stack(
        (torch.full_like(encoding[..., 7], width / 2), torch.full_like(encoding[..., 7], height / 2)), -1
    )
    focal = halves / (torch.tan(encoding[..., 7:].flip(-1) / 2) + focal_epsilon)
    return Cameras(torch.cat((top, bottom), dim=-2), _intrinsics(focal, halves))


def encode_cameras(
    camera_from_world: Float[Tensor, "*b r 4"], intrinsics: Float[Tensor, "*b 3 3"], size: tuple[int, int]
) -> Float[Tensor, "*b 9"]:
    """Encodings of cameras given as 3x4 or 4x4 matrices and pixel intrinsics for images of ``size``.

    Pass ``size`` (1, 1) with normalised intrinsics. The published encoder knows no epsilon, so AnySplat's decoding
    does not undo it exactly.
    """
    height, width = size
    vertical = 2 * torch.atan(height / 2 / intrinsics[..., 1, 1])
    horizontal = 2 * torch.atan(width / 2 / intrinsics[..., 0, 0])
    quaternion = matrix_to_quaternion(camera_from_world[..., :3, :3])
    return torch.cat((camera_from_world[..., :3, 3], quaternion, torch.stack((vertical, horizontal), dim=-1)), dim=-1)


def quaternion_to_matrix(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of a quaternion (x, y, z, w) of any length but zero."""
    x, y, z, w = quaternion.unbind(-1)
    s = 2 / quaternion.square().sum(-1).clamp_min(_SAFE_SQUARE)
    rows = (
        (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def matrix_to_quaternion(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix, by the best-conditioned of four formulas.

    Each row below is 4 times one component of the quaternion times the whole quaternion; the longest row divides
    by the largest component.
    """
    m00, m01, m02 = rotation[..., 0, :].unbind(-1)
    m10, m11, m12 = rotation[..., 1, :].unbind(-1)
    m20, m21, m22 = rotation[..., 2, :].unbind(-1)
    rows = torch.stack(
        [
            torch.stack((1 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12), dim=-1),
            torch.stack((m01 + m10, 1 - m00 + m11 - m22, m12 + m21, m02 - m20), dim=-1),
            torch.stack((m02 + m20, m12 + m21, 1 - m00 - m11 + m22, m10 - m01), dim=-1),
            torch.stack((m21 - m12, m02 - m20, m10 - m01, 1 + m00 + m11 + m22), dim=-1),
        ],
        dim=-2,
    )
    best = torch.diagonal(rows, dim1=-2, dim2=-1).argmax(-1)
    chosen = torch.gather(rows, -2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    unit = chosen / chosen.norm(dim=-1, keepdim=True)
    return torch.where(unit[..., 3:] < 0, -unit, unit)


def _intrinsics(focal: Float[Tensor, "*b 2"], center: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3 3"]:
    zero, one = torch.zeros_like(focal[..., 0]), torch.ones_like(focal[..., 0])
    rows = ((focal[..., 0], zero, center[..., 0]), (zero, focal[..., 1], center[..., 1]), (zero, zero, one))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)

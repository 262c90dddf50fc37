"""Pixels with depth to points, in the camera and in the world."""

import torch
from jaxtyping import Float
from torch import Tensor


def invert_rigid(matrix: Float[Tensor, "*b r 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of rigid motions given as 3x4 or 4x4 matrices."""
    back = matrix[..., :3, :3].transpose(-1, -2)
    top = torch.cat((back, -back @ matrix[..., :3, 3:]), dim=-1)
    bottom = torch.zeros_like(top[..., :1, :]) + top.new_tensor((0.0, 0.0, 0.0, 1.0))
    return torch.cat((top, bottom), dim=-2)


def unproject(
    depth: Float[Tensor, "*b h w"],
    intrinsics: Float[Tensor, "*b 3 3"],
    world_from_camera: Float[Tensor, "*b 4 4"],
    *,
    pixel_center: float = 0.5,
) -> Float[Tensor, "*b h w 3"]:
    """World point of every pixel.

    Args:
        depth: Z-depth.
        intrinsics: In pixels of the size of ``depth``.
        world_from_camera: Camera poses.
        pixel_center: Where in a pixel its ray starts: 0.5 for its middle, 0 for AnySplat's corner.
    """
    points = unproject_to_camera(depth, intrinsics, pixel_center=pixel_center)
    rotation, translation = world_from_camera[..., :3, :3], world_from_camera[..., :3, 3]
    turned = (points.flatten(-3, -2) @ rotation.transpose(-1, -2)).reshape(points.shape)
    return turned + translation[..., None, None, :]


def unproject_to_camera(
    depth: Float[Tensor, "*b h w"], intrinsics: Float[Tensor, "*b 3 3"], *, pixel_center: float = 0.5
) -> Float[Tensor, "*b h w 3"]:
    """Point of every pixel in the axes of its own camera."""
    height, width = depth.shape[-2:]
    columns = torch.arange(width, device=depth.device, dtype=depth.dtype) + pixel_center
    rows = torch.arange(height, device=depth.device, dtype=depth.dtype) + pixel_center
    fx, fy = intrinsics[..., 0, 0], intrinsics[..., 1, 1]
    cx, cy = intrinsics[..., 0, 2], intrinsics[..., 1, 2]
    across = (columns - cx[..., None]) / fx[..., None]
    down = (rows - cy[..., None]) / fy[..., None]
    return torch.stack((depth * across[..., None, :], depth * down[..., :, None], depth), dim=-1)

"""Warps of EndoDAC and EndoDAV, whose pixels begin at whole numbers.

The centre of the first pixel is (0, 0), and the centres of the outermost pixels are the corners of the sampling grid;
elsewhere in Bathyscope (:mod:`~bathyscope_train.losses.warping`) centres are at +0.5.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.unprojection import unproject

_SAFE_DEPTH = 1e-7


def warp_by_flow(source: Float[Tensor, "n c h w"], flow: Float[Tensor, "n 2 h w"]) -> Float[Tensor, "n c h w"]:
    """``source`` sampled at every pixel plus its flow; outside, the border is repeated.

    Args:
        source: Maps to sample.
        flow: Where to, in pixels; channels in the order (y, x).
    """
    height, width = flow.shape[-2:]
    rows = torch.arange(height, device=flow.device, dtype=flow.dtype)[:, None] + flow[:, 0]
    columns = torch.arange(width, device=flow.device, dtype=flow.dtype) + flow[:, 1]
    return sample(source, torch.stack((columns, rows), dim=-1))


def warp_by_depth(
    source: Float[Tensor, "n c h w"],
    depth: Float[Tensor, "n h w"],
    source_from_target: Float[Tensor, "n 4 4"],
    intrinsics: Float[Tensor, "n 3 3"],
) -> Float[Tensor, "n c h w"]:
    """``source`` as the target's camera sees it: sampled where the target's pixels, lifted by ``depth``, project to."""
    pixels, _ = reproject(depth, source_from_target, intrinsics)
    return sample(source, pixels)


def reproject(
    depth: Float[Tensor, "n h w"],
    source_from_target: Float[Tensor, "n 4 4"],
    intrinsics: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n h w 2"], Float[Tensor, "n h w"]]:
    """Where every pixel of the target lies in the source, ``(u, v)`` in pixels, and its depth there.

    Args:
        depth: Z-depth of the target.
        source_from_target: Maps points of the target's camera to the source's.
        intrinsics: Of both, in pixels; the centre of the first pixel is (0, 0).
    """
    points = unproject(depth, intrinsics, source_from_target, pixel_center=0.0)
    projected = points @ intrinsics[:, None].transpose(-1, -2)
    return projected[..., :2] / (projected[..., 2:] + _SAFE_DEPTH), points[..., 2]


def grid_coordinates(pixels: Float[Tensor, "n h w 2"], size: tuple[int, int]) -> Float[Tensor, "n h w 2"]:
    """Pixels ``(u, v)`` of an image of ``size`` (height, width) as -1 to 1 from the first pixel to the last."""
    last = pixels.new_tensor((size[1] - 1, size[0] - 1))
    return 2 * pixels / last - 1


def sample(
    maps: Float[Tensor, "n c h w"], pixels: Float[Tensor, "n h2 w2 2"], *, padding: str = "border"
) -> Float[Tensor, "n c h2 w2"]:
    """Bilinear samples at ``pixels`` (u, v), whole numbers being pixel centres."""
    grid = grid_coordinates(pixels, (maps.shape[-2], maps.shape[-1]))
    return F.grid_sample(maps, grid, mode="bilinear", padding_mode=padding, align_corners=True)

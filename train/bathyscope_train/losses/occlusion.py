"""Which pixels of a target are seen in a source, from the optical flow the other way."""

import torch
from jaxtyping import Float
from torch import Tensor

VISIBLE = 0.95
"""A pixel counts as seen where more than this arrives."""


def visibility_mask(reverse_flow: Float[Tensor, "n 2 h w"], *, threshold: float = VISIBLE) -> Float[Tensor, "n 1 h w"]:
    """1 where pixels of the source arrive, 0 where none do: there the target shows what the source does not.

    Args:
        reverse_flow: From source to target in pixels, channels in the order (y, x).
        threshold: How much of a pixel must arrive.
    """
    return (splat_ones(reverse_flow.detach()) > threshold).to(reverse_flow.dtype)


def splat_ones(flow: Float[Tensor, "n 2 h w"]) -> Float[Tensor, "n 1 h w"]:
    """How much arrives at every pixel when each gives 1 to the four around the place it flows to (bilinear weights).

    What would fall outside is lost.
    """
    n, _, height, width = flow.shape
    rows = torch.arange(height, device=flow.device, dtype=flow.dtype)[:, None] + flow[:, 0]
    columns = torch.arange(width, device=flow.device, dtype=flow.dtype) + flow[:, 1]
    top, left = rows.floor(), columns.floor()
    arrived = flow.new_zeros(n, height * width)
    for down in (0, 1):
        for across in (0, 1):
            row, column = top + down, left + across
            weight = (1 - (rows - row).abs()) * (1 - (columns - column).abs())
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            arrived.scatter_add_(1, index.long().flatten(1), (weight * inside).flatten(1))
    return arrived.reshape(n, 1, height, width)

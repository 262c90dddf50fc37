"""The sinusoidal embedding of the view ray that a DPT head adds to its maps."""

import torch
from jaxtyping import Float
from torch import Tensor

_WEIGHT = 0.1
_BASE = 100.0


def add_view_embedding(maps: Float[Tensor, "n c h w"], image_size: tuple[int, int]) -> Float[Tensor, "n c h w"]:
    """``maps`` plus a tenth of the embedding of their grid, for an image of ``image_size`` (height, width)."""
    c, h, w = maps.shape[-3:]
    u, v = view_coordinates((h, w), image_size, like=maps)
    across = embed_coordinate(u, c // 2).transpose(0, 1)[:, None, :].expand(-1, h, -1)
    down = embed_coordinate(v, c // 2).transpose(0, 1)[:, :, None].expand(-1, -1, w)
    return maps + (_WEIGHT * torch.cat((across, down))).to(maps.dtype)


def view_coordinates(
    size: tuple[int, int], image_size: tuple[int, int], *, like: Tensor
) -> tuple[Float[Tensor, " w"], Float[Tensor, " h"]]:
    """The u of each column and the v of each row: cell centres of an image with unit diagonal half-length."""
    height, width = (torch.full((), side, device=like.device, dtype=torch.float32) for side in image_size)
    diagonal = (height * height + width * width).sqrt()
    return _centers(size[1], width / diagonal, like), _centers(size[0], height / diagonal, like)


def embed_coordinate(coordinate: Float[Tensor, " n"], channels: int) -> Float[Tensor, "n c"]:
    """sin, then cos, of the coordinate times ``channels / 2`` frequencies 100^(-2j / channels)."""
    half = channels // 2
    exponents = torch.arange(half, device=coordinate.device, dtype=torch.float32) / half
    angles = coordinate[:, None] * _BASE**-exponents
    return torch.cat((angles.sin(), angles.cos()), dim=1)


def _centers(count: int, span: Tensor, like: Tensor) -> Float[Tensor, " n"]:
    cells = torch.arange(count, device=like.device, dtype=torch.float32)
    return span * ((2 * cells + 1) / torch.full((), count, device=like.device, dtype=torch.float32) - 1)

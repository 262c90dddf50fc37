"""Rotary position embedding in two dimensions: half of a head is rotated by the row, half by the column.

A patch in row y and column x has position (y + 1, x + 1); special tokens have (0, 0), which rotates
nothing. The frame index is not encoded: a clip is a set of views.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class RopeTables(NamedTuple):
    """Cosine and sine for every token and channel of a head; computed once a forward pass, outside the blocks."""

    cos: Float[Tensor, "n d"]
    sin: Float[Tensor, "n d"]

    def repeat(self, frames: int) -> "RopeTables":
        """The same tables for the tokens of ``frames`` frames laid end to end."""
        return RopeTables(self.cos.repeat(frames, 1), self.sin.repeat(frames, 1))


def grid_positions(height: int, width: int, special: int, *, device: torch.device) -> Float[Tensor, "n 2"]:
    """(y, x) of ``special`` special tokens, then of a ``height`` x ``width`` grid of patches, row by row."""
    rows = torch.arange(1, height + 1, device=device, dtype=torch.float32)
    columns = torch.arange(1, width + 1, device=device, dtype=torch.float32)
    grid = torch.stack((rows[:, None].expand(height, width), columns[None, :].expand(height, width)), dim=-1).reshape(
        height * width, 2
    )
    return torch.cat((grid.new_zeros(special, 2), grid))


def rope_tables(positions: Float[Tensor, "n 2"], head_dim: int, *, base: float = 100.0) -> RopeTables:
    """Tables for tokens at ``positions``; ``head_dim`` is a multiple of 4.

    A half of size d = head_dim / 2 is rotated by the angles pos * base^(-2j/d), j = 0 .. d/2-1, each used twice.
    """
    half = head_dim // 2
    exponents = torch.arange(0, half, 2, device=positions.device, dtype=torch.float32) / half
    angles = positions[:, :, None] * base**-exponents  # (n, 2, half / 2): rows, then columns
    angles = torch.cat((angles, angles), dim=-1).flatten(1)
    return RopeTables(angles.cos(), angles.sin())


def rotate(tokens: Float[Tensor, "b n heads d"], tables: RopeTables) -> Float[Tensor, "b n heads d"]:
    """Rotate each half of a head, half-split and not interleaved: (a, b) -> (a cos - b sin, b cos + a sin)."""
    first, second = tokens.unflatten(-1, (2, 2, -1)).unbind(-2)
    turned = torch.stack((-second, first), dim=-2).flatten(-3)
    cos, sin = tables.cos[:, None, :], tables.sin[:, None, :]
    return (tokens * cos + turned * sin).to(tokens.dtype)

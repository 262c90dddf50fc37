"""The image encoder of Depth Anything: a DINOv2 transformer without registers, tapped at four blocks."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope.errors import GeometryError
from bathyscope_train.model.blocks import Block
from bathyscope_train.model.vit import PatchProjection
from bathyscope_train.systems.depth_anything.positions import resized_positions


class Encoder(nn.Module):
    """Tapped patch tokens of normalised images; each tap goes through the *final* LayerNorm.

    ``mask_token`` is part of the published checkpoints and never read. A module in ``blocks`` may be replaced by
    another of the same call (:class:`~.neck.NeckBlock`), a linear layer in it by an adapted one (:mod:`~.adapters`).

    Args:
        width: Channels of a token.
        depth: Number of blocks.
        heads: Attention heads.
        taps: Blocks whose output the head reads, from 0, rising.
        grid: Side of the learnt position table, in patches.
        patch_size: Side of a patch in pixels.
        mlp_ratio: Hidden width of the MLPs over ``width``.
    """

    def __init__(
        self,
        *,
        width: int,
        depth: int,
        heads: int,
        taps: Sequence[int],
        grid: int = 37,
        patch_size: int = 14,
        mlp_ratio: int = 4,
    ) -> None:
        super().__init__()
        self.taps, self.grid, self.patch_size = tuple(taps), grid, patch_size
        self.cls_token = nn.Parameter(torch.randn(1, 1, width) * 1e-6)
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + grid * grid, width) * 0.02)
        self.mask_token = nn.Parameter(torch.zeros(1, width), requires_grad=False)
        self.patch_embed = PatchProjection(width, patch_size)
        self.blocks = nn.ModuleList(
            Block(width, heads, mlp_ratio=mlp_ratio, epsilon=1e-6, layer_scale=1.0) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(width, eps=1e-6)

    def token_grid(self, size: tuple[int, int]) -> tuple[int, int]:
        """Rows and columns of patches of an image of ``size`` (height, width).

        Raises:
            GeometryError: If a side is not a multiple of the patch size.
        """
        height, width = size
        if height % self.patch_size or width % self.patch_size:
            raise GeometryError(
                f"images of {height}x{width} do not divide into patches of {self.patch_size}; resize them first"
            )
        return height // self.patch_size, width // self.patch_size

    def tokens_in(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
        """Class token and patches with their positions: what the first block reads."""
        size = self.token_grid((images.shape[-2], images.shape[-1]))
        patches = self.patch_embed(images)
        tokens = torch.cat((self.cls_token.expand(patches.shape[0], -1, -1), patches), dim=1)
        return tokens + resized_positions(self.pos_embed, self.grid, size)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "n hw c"], ...]:
        """Patch tokens of the tapped blocks, shallow to deep; sides of the images are multiples of the patch size."""
        tokens, tapped = self.tokens_in(images), []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in self.taps:
                tapped.append(self.norm(tokens)[:, 1:])
        return tuple(tapped)

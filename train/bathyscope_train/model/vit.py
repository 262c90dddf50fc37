"""The DINOv2 vision transformer with registers, as image encoder."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.blocks import Block
from bathyscope_train.model.resizing import resize_bicubic_antialiased


class PatchProjection(nn.Module):
    """Non-overlapping patches to tokens, row by row."""

    def __init__(self, width: int, patch_size: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, patch_size, stride=patch_size)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n hw c"]:
        patches: Tensor = self.proj(images)
        return patches.flatten(2).transpose(1, 2)


class VisionTransformer(nn.Module):
    """DINOv2 ViT with registers; returns the patch tokens after the last norm.

    ``mask_token`` is part of the published checkpoints and never read.

    Args:
        width: Channels of a token.
        depth: Number of blocks.
        heads: Attention heads.
        patch_size: Side of a patch in pixels.
        grid: Side of the learnt position grid, in patches.
        registers: Number of register tokens, inserted after the position embedding.
        mlp_ratio: Hidden width of the MLPs over ``width``.
        layer_scale: Initial factor of the residual branches.
    """

    def __init__(
        self,
        *,
        width: int,
        depth: int,
        heads: int,
        patch_size: int,
        grid: int,
        registers: int,
        mlp_ratio: int = 4,
        layer_scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.patch_size, self.grid, self.registers = patch_size, grid, registers
        self.cls_token = nn.Parameter(torch.randn(1, 1, width) * 1e-6)
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + grid * grid, width) * 0.02)
        self.register_tokens = nn.Parameter(torch.randn(1, registers, width) * 1e-6)
        self.mask_token = nn.Parameter(torch.zeros(1, width), requires_grad=False)
        self.patch_embed = PatchProjection(width, patch_size)
        self.blocks = nn.ModuleList(
            Block(width, heads, mlp_ratio=mlp_ratio, epsilon=1e-6, layer_scale=layer_scale) for _ in range(depth)
        )
        self.norm = nn.LayerNorm(width, eps=1e-6)

    def tokens_in(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n p c"]:
        """Class token, registers, patches: what the first block reads. Registers carry no position."""
        n, _, height, width = images.shape
        patches = self.patch_embed(images)
        class_position, grid = position_embedding(
            self.pos_embed, self.grid, (height // self.patch_size, width // self.patch_size)
        )
        return torch.cat(
            (
                (self.cls_token + class_position).expand(n, -1, -1),
                self.register_tokens.expand(n, -1, -1),
                patches + grid,
            ),
            dim=1,
        )

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n hw c"]:
        """Encode ImageNet-normalised images whose sides are multiples of the patch size."""
        tokens = self.tokens_in(images)
        for block in self.blocks:
            tokens = block(tokens)
        normed: Tensor = self.norm(tokens)
        return normed[:, 1 + self.registers :]


def position_embedding(
    embedding: Float[Tensor, "1 p c"], grid: int, size: tuple[int, int]
) -> tuple[Float[Tensor, "1 1 c"], Float[Tensor, "1 hw c"]]:
    """Split a learnt embedding into its class part and its grid, resized to ``size`` patches (antialiased bicubic)."""
    square = embedding[:, 1:].float().unflatten(1, (grid, grid)).permute(0, 3, 1, 2)
    resized = resize_bicubic_antialiased(square, size).flatten(2).transpose(1, 2)
    return embedding[:, :1], resized.to(embedding.dtype)

"""EndoDAC's convolutional neck: after chosen blocks, patch tokens are also seen as a map."""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope.errors import GeometryError
from bathyscope_train.model.blocks import Block
from bathyscope_train.model.rope import RopeTables

_REDUCTION = 8


class ChannelNorm(nn.Module):
    """LayerNorm over the channels of each pixel, eps 1e-6."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        pixels = F.layer_norm(maps.movedim(1, -1), self.weight.shape, self.weight, self.bias, 1e-6)
        return pixels.movedim(-1, 1)


class Neck(nn.Module):
    """conv1x1, norm, GELU, conv3x3, norm, GELU, conv1x1, norm, through an eighth of the channels; no biases.

    The last norm starts with factors of zero, so that a fresh neck changes nothing.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        inner = width // _REDUCTION
        self.conv1 = nn.Conv2d(width, inner, 1, bias=False)
        self.norm1 = ChannelNorm(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, padding=1, bias=False)
        self.norm2 = ChannelNorm(inner)
        self.conv3 = nn.Conv2d(inner, width, 1, bias=False)
        self.norm3 = ChannelNorm(width)
        nn.init.zeros_(self.norm3.weight)

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        hidden = F.gelu(self.norm1(self.conv1(maps)))
        hidden = F.gelu(self.norm2(self.conv2(hidden)))
        result: Tensor = self.norm3(self.conv3(hidden))
        return result


class NeckBlock(Block):
    """A transformer block of the encoder, then the neck added to its patch tokens; the class token passes by.

    Args:
        width: Channels of a token.
        heads: Attention heads.
        grid: Rows and columns of patches: fixed, because tokens do not say how they lie.
        mlp_ratio: Hidden width of the MLP over ``width``.
    """

    def __init__(self, width: int, heads: int, *, grid: tuple[int, int], mlp_ratio: int = 4) -> None:
        super().__init__(width, heads, mlp_ratio=mlp_ratio, epsilon=1e-6, layer_scale=1.0)
        self.grid = grid
        self.residual_ = Neck(width)

    def forward(self, tokens: Float[Tensor, "b n c"], rope: RopeTables | None = None) -> Float[Tensor, "b n c"]:
        tokens = super().forward(tokens, rope)
        patches = tokens[:, 1:]
        if patches.shape[1] != self.grid[0] * self.grid[1]:
            raise GeometryError(
                f"the neck was built for {self.grid[0]}x{self.grid[1]} patches, got {patches.shape[1]} tokens; "
                "resize the images to the size that the network was built for"
            )
        maps: Tensor = self.residual_(patches.transpose(1, 2).unflatten(2, self.grid))
        return torch.cat((tokens[:, :1], patches + maps.flatten(2).transpose(1, 2)), dim=1)


def add_necks(blocks: nn.ModuleList, after: Iterable[int], *, grid: tuple[int, int]) -> None:
    """Replace, in place, the encoder's blocks numbered ``after`` by fresh ones with a neck for ``grid``."""
    for index in after:
        old = blocks[index]
        assert isinstance(old, Block)
        width, hidden = old.mlp.fc1.in_features, old.mlp.fc1.out_features
        blocks[index] = NeckBlock(width, old.attn.heads, grid=grid, mlp_ratio=hidden // width)

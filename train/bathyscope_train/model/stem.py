"""Convolutional image stem of the tiny preset: patch tokens and the fine maps that the heads read.

A bare 14-pixel patch projection must learn edges and textures from scratch in one linear map. A few small
convolutions first give that away for little, and their maps at half and quarter size carry the detail that
the tokens lose.
"""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.lite0 import CHANNELS, Lite0Encoder
from bathyscope_train.model.view_embedding import add_view_embedding

CELL = 4
"""Side of a cell of the finer grid that correspondences live on, in pixels."""


class ResidualConv(nn.Module):
    """x + conv(relu(x)), 3x3."""

    def __init__(self, channels: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        result: Tensor = maps + self.conv(F.relu(maps))
        return result


class ConvStem(nn.Module):
    """Tokens of patches from a pyramid of convolutions at 1/2 and 1/4 of the image.

    Args:
        width: Channels of a token.
        channels: Channels of the half-size map; the quarter-size map has twice as many.
        patch_size: Side of a patch; even.
    """

    def __init__(self, width: int, *, channels: int = 32, patch_size: int = 14) -> None:
        super().__init__()
        side = patch_size // 2
        self.to_half = nn.Sequential(nn.Conv2d(3, channels, 3, stride=2, padding=1), ResidualConv(channels))
        self.to_quarter = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(channels, 2 * channels, 3, stride=2, padding=1),
            ResidualConv(2 * channels),
            ResidualConv(2 * channels),
        )
        self.proj = nn.Conv2d(channels, width, side, stride=side)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "n hw c"], tuple[Tensor, Tensor]]:
        """Patch tokens, row by row, and the maps (n, k, h/2, w/2) and (n, 2 k, h/4, w/4), both rounded up."""
        half = self.to_half(images)
        quarter = self.to_quarter(half)
        return _as_tokens(self.proj(F.relu(half)), images), (half, quarter)


class EncodedStem(ConvStem):
    """The convolutional stem, to whose maps and tokens the features of a pre-trained encoder are added.

    Half- and quarter-size maps gain what the encoder has at their size; tokens gain its maps at 1/8 and 1/16, resampled
    to the grid of the patches.

    Args:
        width: Channels of a token.
        channels: Channels of the half-size map.
        patch_size: Side of a patch; even.
    """

    def __init__(self, width: int, *, channels: int = 32, patch_size: int = 14) -> None:
        super().__init__(width, channels=channels, patch_size=patch_size)
        half, quarter, *coarse = CHANNELS
        self.encoder = Lite0Encoder()
        self.add_half = nn.Conv2d(half, channels, 1)
        self.add_quarter = nn.Conv2d(quarter, 2 * channels, 1)
        self.add_tokens = nn.ModuleList(nn.Conv2d(count, width, 1) for count in coarse)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "n hw c"], tuple[Tensor, Tensor]]:
        """As the plain stem's."""
        encoded = self.encoder(images)
        half = self.to_half(images) + self.add_half(encoded[0])
        quarter = self.to_quarter(half) + self.add_quarter(encoded[1])
        tokens = self.proj(F.relu(half))
        for add, maps in zip(self.add_tokens, encoded[2:], strict=True):
            tokens = tokens + resize(add(maps), (tokens.shape[-2], tokens.shape[-1]))
        return _as_tokens(tokens, images), (half, quarter)


def resize(maps: Float[Tensor, "n c h w"], size: tuple[int, int]) -> Float[Tensor, "n c h2 w2"]:
    """Bilinear, corners of the outer pixels aligned."""
    return F.interpolate(maps, size=size, mode="bilinear", align_corners=False)


def _as_tokens(maps: Float[Tensor, "n c h w"], images: Float[Tensor, "n 3 h2 w2"]) -> Float[Tensor, "n hw c"]:
    """Row by row, each with where it looks."""
    placed = add_view_embedding(maps, (images.shape[-2], images.shape[-1]))
    return placed.flatten(2).transpose(1, 2)

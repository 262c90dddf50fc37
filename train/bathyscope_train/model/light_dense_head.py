"""Dense heads of the tiny preset: tokens, then the stem's quarter- and half-size maps, then the image itself.

The shape of a DPT head (coarse to fine, skip connections, residual convolutions) at a hundredth of its
cost: most of the work happens at a quarter of the image's size.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.presets import LightHeadSettings
from bathyscope_train.model.stem import ResidualConv, resize
from bathyscope_train.model.view_embedding import add_view_embedding


class LightDenseHead(nn.Module):
    """Maps of the size of the image from tapped tokens and stem maps; frames do not see each other.

    Args:
        width: Channels of a tapped token.
        taps: How many layers are tapped.
        settings: Sizes of the head.
        stem_channels: Channels of the stem's half-size map; its quarter-size map has twice as many.
        patch_size: Side of a patch in pixels.
        extra: Channels of further full-size maps that are read beside the image.
        outputs: Channels of the result.
    """

    def __init__(
        self,
        width: int,
        taps: int,
        settings: LightHeadSettings,
        *,
        stem_channels: int,
        patch_size: int,
        outputs: int,
        extra: int = 0,
    ) -> None:
        super().__init__()
        coarse, half = settings.coarse, settings.coarse // 2
        self.patch_size = patch_size
        self.norms = nn.ModuleList(nn.LayerNorm(width, eps=1e-5) for _ in range(taps))
        self.projects = nn.ModuleList(nn.Linear(width, coarse) for _ in range(taps))
        self.refine_tokens = ResidualConv(coarse)
        self.quarter_skip = nn.Conv2d(2 * stem_channels, coarse, 1)
        self.refine_quarter = nn.Sequential(*(ResidualConv(coarse) for _ in range(settings.blocks)))
        self.narrow = nn.Conv2d(coarse, half, 1)
        self.half_skip = nn.Conv2d(stem_channels, half, 1)
        self.refine_half = nn.Sequential(*(ResidualConv(half) for _ in range(settings.blocks)))
        self.to_full = nn.Conv2d(half, settings.fine, 1)
        self.full = nn.Conv2d(settings.fine + 3 + extra, settings.fine, 3, padding=1)
        self.readout = nn.Conv2d(settings.fine, outputs, 1)

    def forward(
        self,
        taps: Sequence[Float[Tensor, "n hw c"]],
        images: Float[Tensor, "n 3 h w"],
        stem_maps: Sequence[Float[Tensor, "n k h2 w2"]],
        *,
        extra: Float[Tensor, "n e h w"] | None = None,
    ) -> Float[Tensor, "n o h w"]:
        """Raw maps for images in [0, 1]."""
        size = _size(images)
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        half, quarter = stem_maps
        tokens = torch.stack(
            [project(norm(tap)) for tap, norm, project in zip(taps, self.norms, self.projects, strict=True)]
        ).sum(0)
        maps = add_view_embedding(tokens.transpose(1, 2).unflatten(2, grid), size)
        maps = resize(self.refine_tokens(maps), _size(quarter)) + self.quarter_skip(quarter)
        maps = resize(self.narrow(F.relu(self.refine_quarter(maps))), _size(half)) + self.half_skip(half)
        maps = resize(self.to_full(F.relu(self.refine_half(maps))), size)
        maps = torch.cat([maps, images] if extra is None else [maps, images, extra], 1)
        raw: Tensor = self.readout(F.relu(self.full(maps)))
        return raw


class LightDepthHead(LightDenseHead):
    """Raw log depth and raw confidence; starts at depth 1 everywhere."""

    def __init__(
        self, width: int, taps: int, settings: LightHeadSettings, *, stem_channels: int, patch_size: int
    ) -> None:
        super().__init__(width, taps, settings, stem_channels=stem_channels, patch_size=patch_size, outputs=2)
        nn.init.normal_(self.readout.weight, std=0.01)
        nn.init.zeros_(_bias(self.readout))


class LightGaussianHead(LightDenseHead):
    """Raw parameters of one Gaussian a pixel, from appearance, tokens and the predicted depth.

    It reads the depth (as logarithm about the frame's mean, without a gradient), because opacity says
    whether that very depth can be trusted, and rotation and scales follow its slope. It starts as half
    transparent, unturned, pixel-sized Gaussians in the colour of their pixel.
    """

    def __init__(
        self, width: int, taps: int, settings: LightHeadSettings, *, stem_channels: int, patch_size: int, outputs: int
    ) -> None:
        super().__init__(
            width, taps, settings, stem_channels=stem_channels, patch_size=patch_size, outputs=outputs, extra=1
        )
        nn.init.normal_(self.readout.weight, std=0.01)
        nn.init.zeros_(_bias(self.readout))

    def predict(
        self,
        taps: Sequence[Float[Tensor, "n hw c"]],
        images: Float[Tensor, "n 3 h w"],
        stem_maps: Sequence[Float[Tensor, "n k h2 w2"]],
        depth: Float[Tensor, "n h w"],
    ) -> Float[Tensor, "n o h w"]:
        """Raw maps for a predicted depth."""
        logarithm = depth.detach().log()
        centred = logarithm - logarithm.mean((-2, -1), keepdim=True)
        return self.forward(taps, images, stem_maps, extra=4 * centred[:, None])


def _size(maps: Tensor) -> tuple[int, int]:
    return maps.shape[-2], maps.shape[-1]


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return layer.bias

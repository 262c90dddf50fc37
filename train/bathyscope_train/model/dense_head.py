"""The dense prediction transformer (DPT): tapped tokens of one frame to a map of its size."""

from collections.abc import Sequence

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.presets import DptSettings
from bathyscope_train.model.view_embedding import add_view_embedding


class ResidualConvUnit(nn.Module):
    """relu, conv, relu, conv, added to relu(x): the published weights were trained with an in-place ReLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        positive = F.relu(maps)
        residual: Tensor = self.conv2(F.relu(self.conv1(positive)))
        return residual + positive


class FusionBlock(nn.Module):
    """Adds a finer level to a coarser one, refines and resizes."""

    def __init__(self, channels: int, *, with_skip: bool) -> None:
        super().__init__()
        if with_skip:
            self.resConfUnit1 = ResidualConvUnit(channels)
        self.resConfUnit2 = ResidualConvUnit(channels)
        self.out_conv = nn.Conv2d(channels, channels, 1)

    def forward(self, coarse: Tensor, skip: Tensor | None, size: tuple[int, int]) -> Float[Tensor, "n c h w"]:
        if skip is not None:
            coarse = coarse + self.resConfUnit1(skip)
        resized = resize_bilinear(self.resConfUnit2(coarse), size)
        fused: Tensor = self.out_conv(resized)
        return fused


class Scratch(nn.Module):
    """The convolutional half of a DPT head, named as in the published checkpoints."""

    def __init__(self, settings: DptSettings, outputs: int) -> None:
        super().__init__()
        features = settings.features
        first, second, third, fourth = settings.channels
        self.layer1_rn = nn.Conv2d(first, features, 3, padding=1, bias=False)
        self.layer2_rn = nn.Conv2d(second, features, 3, padding=1, bias=False)
        self.layer3_rn = nn.Conv2d(third, features, 3, padding=1, bias=False)
        self.layer4_rn = nn.Conv2d(fourth, features, 3, padding=1, bias=False)
        self.refinenet1 = FusionBlock(features, with_skip=True)
        self.refinenet2 = FusionBlock(features, with_skip=True)
        self.refinenet3 = FusionBlock(features, with_skip=True)
        self.refinenet4 = FusionBlock(features, with_skip=False)
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, settings.hidden, 3, padding=1), nn.ReLU(), nn.Conv2d(settings.hidden, outputs, 1)
        )

    def fuse(self, levels: Sequence[Tensor]) -> Float[Tensor, "n c h w"]:
        """Four levels, fine to coarse, to one map of twice the size of the finest."""
        fine = self.layer1_rn(levels[0])
        middle = self.layer2_rn(levels[1])
        coarse = self.layer3_rn(levels[2])
        fused = self.refinenet4(self.layer4_rn(levels[3]), None, _size(coarse))
        fused = self.refinenet3(fused, coarse, _size(middle))
        fused = self.refinenet2(fused, middle, _size(fine))
        height, width = _size(fine)
        fused = self.refinenet1(fused, fine, (2 * height, 2 * width))
        narrowed: Tensor = self.output_conv1(fused)
        return narrowed


class DptHead(nn.Module):
    """Maps of the size of the image from the patch tokens of four layers.

    Args:
        width: Channels of a tapped token.
        settings: Sizes of the head.
        outputs: Channels of the result.
        patch_size: Side of a patch in pixels.
    """

    def __init__(self, width: int, settings: DptSettings, *, outputs: int, patch_size: int = 14) -> None:
        super().__init__()
        self.patch_size = patch_size
        first, second, _, fourth = settings.channels
        self.norm = nn.LayerNorm(width, eps=1e-5)
        self.projects = nn.ModuleList(nn.Conv2d(width, channels, 1) for channels in settings.channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(first, first, 4, stride=4),
                nn.ConvTranspose2d(second, second, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(fourth, fourth, 3, stride=2, padding=1),
            )
        )
        self.scratch = Scratch(settings, outputs)

    def fused(self, taps: Sequence[Float[Tensor, "n hw c"]], size: tuple[int, int]) -> Float[Tensor, "n c h w"]:
        """The fused features at image size, before the last view embedding."""
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        levels = []
        for tokens, project, resize in zip(taps, self.projects, self.resize_layers, strict=True):
            maps = self.norm(tokens).transpose(1, 2).unflatten(2, grid)
            levels.append(resize(add_view_embedding(project(maps), size)))
        return resize_bilinear(self.scratch.fuse(levels), size)

    def finish(self, fused: Float[Tensor, "n c h w"]) -> Float[Tensor, "n o h w"]:
        """The last two convolutions."""
        maps: Tensor = self.scratch.output_conv2(add_view_embedding(fused, _size(fused)))
        return maps

    def forward(self, taps: Sequence[Float[Tensor, "n hw c"]], images: Float[Tensor, "n 3 h w"]) -> Tensor:
        """Raw maps (n, o, h, w) for frames of the size of ``images``."""
        return self.finish(self.fused(taps, _size(images)))


class DepthHead(DptHead):
    """Depth and confidence: exp of the first channel, 1 + exp of the second."""

    def __init__(self, width: int, settings: DptSettings, *, patch_size: int = 14) -> None:
        super().__init__(width, settings, outputs=2, patch_size=patch_size)


def activate_depth(raw: Float[Tensor, "n 2 h w"]) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    """Depth (positive, relative) and confidence (above 1) from a depth head's raw maps."""
    return raw[:, 0].exp(), 1 + raw[:, 1].exp()


def resize_bilinear(maps: Float[Tensor, "n c h w"], size: tuple[int, int]) -> Float[Tensor, "n c h2 w2"]:
    """Bilinear, corners aligned: the only resizing a DPT head does."""
    return F.interpolate(maps, size=size, mode="bilinear", align_corners=True)


def _size(maps: Tensor) -> tuple[int, int]:
    return maps.shape[-2], maps.shape[-1]

"""Video Depth Anything: windows of frames to disparity, or to depth in metres."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.systems.depth_anything.encoder import Encoder
from bathyscope_train.systems.vda.head import VideoHead
from bathyscope_train.systems.vda.settings import VdaSettings

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet, by which images are normalised."""
_LEVEL1_A_PATCH = 4
"""Pixels of level 1 along a side of a patch."""


class VideoDepthAnything(nn.Module):
    """The network; what its values are depends on the weights, which are relative or metric and look the same.

    Relative weights give disparity up to a scale and a shift a clip (near is large), metric ones z-depth in metres.
    """

    def __init__(self, settings: VdaSettings) -> None:
        super().__init__()
        self.settings = settings
        self.pretrained = Encoder(
            width=settings.width,
            depth=settings.depth,
            heads=settings.heads,
            taps=settings.taps,
            grid=settings.grid,
            patch_size=settings.patch_size,
            mlp_ratio=settings.mlp_ratio,
        )
        self.head = VideoHead(settings)

    def forward(self, images: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b t h w"]:
        """Values of every frame of windows of images in [0, 1], never negative.

        Raises:
            GeometryError: If a side is not a multiple of the patch size, or a window is too long.
        """
        return self.on_normalised(normalised(images))

    def mixed(self, frames: Float[Tensor, "t 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """First stage of an exported network: all that :meth:`finish` reads of the frames of one window in [0, 1]."""
        taps = self.pretrained(normalised(frames))
        grid = self.pretrained.token_grid((frames.shape[-2], frames.shape[-1]))
        return self.head.mixed(taps, grid, frames.shape[0])

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Float[Tensor, "n h w"]:
        """Second stage, which takes most memory and may run in chunks of frames."""
        patch = self.settings.patch_size
        rows, columns = (side // _LEVEL1_A_PATCH for side in level1.shape[-2:])
        return self.head.finish(path3, level2, level1, (patch * rows, patch * columns))

    def on_normalised(self, images: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b t h w"]:
        """The same for images that are normalised already."""
        b, t, _, height, width = images.shape
        taps = self.pretrained(images.flatten(0, 1))
        values: Tensor = self.head(taps, self.pretrained.token_grid((height, width)), t, (height, width))
        stacked: Tensor = values.unflatten(0, (b, t))
        return stacked


def normalised(images: Float[Tensor, "*n 3 h w"]) -> Float[Tensor, "*n 3 h w"]:
    """RGB with ImageNet's mean and standard deviation taken out."""
    mean = torch.tensor(MEAN, device=images.device, dtype=images.dtype)[:, None, None]
    std = torch.tensor(STD, device=images.device, dtype=images.dtype)[:, None, None]
    return (images - mean) / std

"""The DPT head of Video Depth Anything: four temporal modules between its levels, and one positive map a frame."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.depth_anything.pyramid import Between, Pyramid, Scratch
from bathyscope_train.systems.vda.settings import VdaSettings
from bathyscope_train.systems.vda.temporal import TemporalModule

_HIDDEN = 32


class VideoScratch(Scratch):
    """The trunk's convolutions and the two output layers."""

    def __init__(self, channels: Sequence[int], features: int) -> None:
        super().__init__(channels, features)
        half = features // 2
        self.output_conv1 = nn.Conv2d(features, half, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(half, _HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(_HIDDEN, 1, 1), nn.ReLU()
        )


class VideoHead(Pyramid):
    """Tapped tokens of a window's frames to maps of the size of the images.

    Args:
        settings: Sizes of the network.
        frames_at_once: Frames that the fine half runs on at a time, where most memory goes; does not change the result.
    """

    def __init__(self, settings: VdaSettings, *, frames_at_once: int = 4) -> None:
        super().__init__(settings.width, features=settings.features, channels=settings.channels)
        self.frames_at_once = frames_at_once
        self.scratch: VideoScratch = VideoScratch(settings.channels, settings.features)
        self.motion_modules = motion_modules(settings)

    def mixed(
        self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int], frames: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Path 3, which has seen the whole window, and levels 2 and 1: all that the fine half reads."""
        levels = self.levels(taps, grid)
        path3, _ = self.coarse(levels, through_time(self.motion_modules, frames))
        return path3, levels[1], levels[0]

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor, size: tuple[int, int]) -> Float[Tensor, "n h w"]:
        """The fine half: maps of ``size`` (height, width), never negative; frames do not see each other here."""
        path1, _ = self.fine(path3, level2, level1)
        maps = resize_bilinear(self.scratch.output_conv1(path1), size)
        with torch.autocast(maps.device.type, enabled=False):
            finished: Tensor = self.scratch.output_conv2(maps.float())
        return finished[:, 0]

    def forward(
        self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int], frames: int, size: tuple[int, int]
    ) -> Float[Tensor, "n h w"]:
        """Maps of n = b * ``frames`` frames."""
        chunks = zip(*(maps.split(self.frames_at_once) for maps in self.mixed(taps, grid, frames)), strict=True)
        return torch.cat([self.finish(path3, level2, level1, size) for path3, level2, level1 in chunks])


def motion_modules(settings: VdaSettings) -> nn.ModuleList:
    """A head's four temporal modules."""
    return nn.ModuleList(
        TemporalModule(channels, heads=settings.motion_heads, groups=settings.motion_groups, frames=settings.frames)
        for channels in settings.motion_channels
    )


def through_time(modules: nn.ModuleList, frames: int) -> Between:
    """What happens between the levels of a trunk: the temporal modules, for windows of ``frames`` frames each."""

    def between(place: int, maps: Tensor) -> Tensor:
        seen: Tensor = modules[place](maps.unflatten(0, (-1, frames)))
        return seen.flatten(0, 1)

    return between

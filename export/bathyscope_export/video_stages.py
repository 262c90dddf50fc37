"""A video network cut into the two graphs of its bundle.

``backbone`` sees a whole window; ``heads`` take most memory, see frame by frame, and are fed a few frames at a time.
"""

import torch
from torch import Tensor, nn
from torch.export import Dim

from bathyscope_export.stages import Stage
from bathyscope_train.systems.video_networks import TwoStages, VideoNetwork

_FRAMES, _ROWS, _COLUMNS = 4, 5, 7
_SMALLEST_SIDE, _LARGEST_SIDE = 2, 512
_MAPS = ("path_3", "level_2", "level_1")
_SIDES = (2, 2, 4)
"""Pixels of each of these maps along a side of a patch."""


def split_video(video: VideoNetwork) -> tuple[Stage, Stage]:
    """Backbone and heads of a video network."""
    patch = video.patch
    images = torch.rand(_FRAMES, 3, patch * _ROWS, patch * _COLUMNS, generator=torch.Generator().manual_seed(0))
    backbone = VideoBackbone(video.network)
    with torch.no_grad():
        maps = backbone(images)
    most = video.spec.windows.length if video.spec.windows is not None else 4096
    frames = Dim("frames", min=1, max=most)
    rows, columns = (Dim(name, min=_SMALLEST_SIDE, max=_LARGEST_SIDE) for name in ("rows", "columns"))
    if video.follows_input:
        seen = {0: frames, 2: patch * rows, 3: patch * columns}
        held = tuple({0: frames, 2: side * rows, 3: side * columns} for side in _SIDES)
    else:
        seen = {0: frames, 2: Dim.DYNAMIC, 3: Dim.DYNAMIC}
        held = tuple({0: frames} for _ in _SIDES)
    return (
        Stage("backbone", backbone, (images,), ("images",), _MAPS, shapes=(seen,)),
        Stage("heads", VideoHeads(video.network), maps, _MAPS, ("values",), shapes=held),
    )


class VideoBackbone(nn.Module):
    """Frames (t, 3, h, w) of one window to the three maps that the heads read."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return _stages(self.network).mixed(images)


class VideoHeads(nn.Module):
    """The three maps of some frames to their values (t, h, w)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Tensor:
        return _stages(self.network).finish(path3, level2, level1)


def _stages(network: nn.Module) -> TwoStages:
    """The same module under the names that it is known to have."""
    stages: TwoStages = network  # type: ignore[assignment]
    return stages

"""The two heads of EndoDAV: both see the window through Video Depth Anything's temporal modules."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.depth_anything.disparity import SigmoidPyramid
from bathyscope_train.systems.vda.head import VideoHead, motion_modules, through_time
from bathyscope_train.systems.vda.settings import VdaSettings

SCALES = 4


class SigmoidVideoHead(SigmoidPyramid):
    """Four disparities in (0, 1) of every frame of a window, at 16, 8, 4 and 2 times the token grid."""

    def __init__(self, settings: VdaSettings) -> None:
        super().__init__(settings.width, features=settings.features, channels=settings.channels)
        self.motion_modules = motion_modules(settings)

    def window(
        self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int], frames: int
    ) -> tuple[Float[Tensor, "n 1 h w"], ...]:
        """Disparities of n = b * ``frames`` frames, fine to coarse."""
        return self.disparities(self.paths(taps, grid, through_time(self.motion_modules, frames)))


class HalvedVideoHead(VideoHead):
    """Video Depth Anything's head; coarser scales are its output halved (bilinear, corners aligned, rounded down)."""

    def __init__(self, settings: VdaSettings, *, sigmoid: bool) -> None:
        super().__init__(settings)
        self.patch_size = settings.patch_size
        if sigmoid:
            self.scratch.output_conv2[-1] = nn.Sigmoid()

    def window(
        self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int], frames: int
    ) -> tuple[Float[Tensor, "n 1 h w"], ...]:
        """Disparities of n = b * ``frames`` frames, fine to coarse; the finest has the size of the network's input."""
        size = (grid[0] * self.patch_size, grid[1] * self.patch_size)
        scales = [self(taps, grid, frames, size)[:, None]]
        for _ in range(SCALES - 1):
            height, width = scales[-1].shape[-2:]
            scales.append(resize_bilinear(scales[-1], (height // 2, width // 2)))
        return tuple(scales)

"""Sigmoid disparities at four scales."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.depth_anything.pyramid import Pyramid

_HIDDEN = 32


class Doubling(nn.Module):
    """Bilinear to twice the size, corners aligned."""

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
        return resize_bilinear(maps, (2 * maps.shape[-2], 2 * maps.shape[-1]))


class SigmoidDisparity(nn.Module):
    """conv3x3, twice the size, conv3x3, ReLU, conv1x1, sigmoid: one path to a disparity in (0, 1)."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.head = nn.Sequential(
            nn.Conv2d(features, features // 2, 3, padding=1),
            Doubling(),
            nn.Conv2d(features // 2, _HIDDEN, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(_HIDDEN, 1, 1),
            nn.Sigmoid(),
        )

    def forward(self, path: Float[Tensor, "n c h w"]) -> Float[Tensor, "n 1 h2 w2"]:
        disparity: Tensor = self.head(path)
        return disparity


class SigmoidPyramid(Pyramid):
    """The trunk with a sigmoid disparity of each path; the first is 16 times the token grid, each next one half."""

    def __init__(self, width: int, *, features: int, channels: Sequence[int]) -> None:
        super().__init__(width, features=features, channels=channels)
        self.conv_depth_1 = SigmoidDisparity(features)
        self.conv_depth_2 = SigmoidDisparity(features)
        self.conv_depth_3 = SigmoidDisparity(features)
        self.conv_depth_4 = SigmoidDisparity(features)

    @property
    def output_layers(self) -> tuple[SigmoidDisparity, ...]:
        """The four output layers, fine to coarse: what is trained of the head."""
        return self.conv_depth_1, self.conv_depth_2, self.conv_depth_3, self.conv_depth_4

    def disparities(self, paths: Sequence[Float[Tensor, "n c h w"]]) -> tuple[Float[Tensor, "n 1 h2 w2"], ...]:
        """Disparities in (0, 1) of paths 1 to 4."""
        return tuple(output(path) for output, path in zip(self.output_layers, paths, strict=True))

    def forward(
        self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int]
    ) -> tuple[Float[Tensor, "n 1 h2 w2"], ...]:
        """Disparities of single images from tapped tokens, fine to coarse."""
        return self.disparities(self.paths(taps, grid))

    def finish(self, path3: Float[Tensor, "n c h3 w3"], level2: Tensor, level1: Tensor) -> Float[Tensor, "n h w"]:
        """The finest disparity alone, from what the fine half reads."""
        path1, _ = self.fine(path3, level2, level1)
        disparity: Tensor = self.conv_depth_1(path1)
        return disparity[:, 0]

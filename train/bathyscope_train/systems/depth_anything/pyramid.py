"""The trunk of Depth Anything's DPT head: four tapped layers to four fused paths.

Levels and paths count from 1, fine to coarse, as in the checkpoints: level 1 has four times the resolution of the token
grid, level 4 half of it; path 1 has eight times, path 4 the resolution of level 3.
"""

from collections.abc import Callable, Sequence

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import FusionBlock, ResidualConvUnit

Between = Callable[[int, Tensor], Tensor]
"""What may happen to maps on their way: given a place, returns maps of the same shape.

Place 0 is level 3, place 1 level 4, place 2 path 4 and place 3 path 3: where video models have a temporal module each.
"""


def nothing_between(place: int, maps: Tensor) -> Tensor:
    """The still-image head: maps pass as they are."""
    del place
    return maps


class PlainConvUnit(ResidualConvUnit):
    """relu, conv, relu, conv, added to x: unlike its parent's, this ReLU was not in place."""

    def forward(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        residual: Tensor = self.conv2(F.relu(self.conv1(F.relu(maps))))
        return residual + maps


class Fusion(FusionBlock):
    """Fusion with plain units. All four have both units; the coarsest never reads its first."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, with_skip=False)
        self.resConfUnit1 = PlainConvUnit(channels)
        self.resConfUnit2 = PlainConvUnit(channels)


class Scratch(nn.Module):
    """The convolutions of the trunk, named as in the published checkpoints."""

    def __init__(self, channels: Sequence[int], features: int) -> None:
        super().__init__()
        first, second, third, fourth = channels
        self.layer1_rn = nn.Conv2d(first, features, 3, padding=1, bias=False)
        self.layer2_rn = nn.Conv2d(second, features, 3, padding=1, bias=False)
        self.layer3_rn = nn.Conv2d(third, features, 3, padding=1, bias=False)
        self.layer4_rn = nn.Conv2d(fourth, features, 3, padding=1, bias=False)
        self.refinenet1 = Fusion(features)
        self.refinenet2 = Fusion(features)
        self.refinenet3 = Fusion(features)
        self.refinenet4 = Fusion(features)


class Pyramid(nn.Module):
    """Tapped tokens to paths. A head is a subclass with output layers (and temporal modules) and a ``forward``.

    The work is in two halves, because the fine half takes most memory and a long clip wants it in chunks of frames.

    Args:
        width: Channels of a tapped token.
        features: Channels of a path.
        channels: Channels of levels 1 to 4.
    """

    def __init__(self, width: int, *, features: int, channels: Sequence[int]) -> None:
        super().__init__()
        first, second, _, fourth = channels
        self.projects = nn.ModuleList(nn.Conv2d(width, outputs, 1) for outputs in channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(first, first, 4, stride=4),
                nn.ConvTranspose2d(second, second, 2, stride=2),
                nn.Identity(),
                nn.Conv2d(fourth, fourth, 3, stride=2, padding=1),
            )
        )
        self.scratch = Scratch(channels, features)

    def levels(self, taps: Sequence[Float[Tensor, "n hw c"]], grid: tuple[int, int]) -> list[Tensor]:
        """Levels 1 to 4 of the tapped tokens of frames with ``grid`` (rows, columns) of patches."""
        maps = [tokens.transpose(1, 2).unflatten(2, grid) for tokens in taps]
        return [
            resize(project(each)) for each, project, resize in zip(maps, self.projects, self.resize_layers, strict=True)
        ]

    def coarse(
        self, levels: Sequence[Tensor], between: Between = nothing_between
    ) -> tuple[Float[Tensor, "n c h3 w3"], Float[Tensor, "n c h4 w4"]]:
        """Paths 3 and 4: the half in which frames may see each other."""
        scratch, (_, level2, level3, level4) = self.scratch, levels
        level3, level4 = between(0, level3), between(1, level4)
        path4 = scratch.refinenet4(scratch.layer4_rn(level4), None, _size(level3))
        path4 = between(2, path4)
        path3 = scratch.refinenet3(path4, scratch.layer3_rn(level3), _size(level2))
        return between(3, path3), path4

    def fine(
        self, path3: Float[Tensor, "n c h3 w3"], level2: Tensor, level1: Tensor
    ) -> tuple[Float[Tensor, "n c h1 w1"], Float[Tensor, "n c h2 w2"]]:
        """Paths 1 and 2, of any number of frames."""
        scratch = self.scratch
        path2 = scratch.refinenet2(path3, scratch.layer2_rn(level2), _size(level1))
        height, width = _size(level1)
        path1 = scratch.refinenet1(path2, scratch.layer1_rn(level1), (2 * height, 2 * width))
        return path1, path2

    def paths(
        self,
        taps: Sequence[Float[Tensor, "n hw c"]],
        grid: tuple[int, int],
        between: Between = nothing_between,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Paths 1 to 4 of all frames at once."""
        levels = self.levels(taps, grid)
        path3, path4 = self.coarse(levels, between)
        path1, path2 = self.fine(path3, levels[1], levels[0])
        return path1, path2, path3, path4


def _size(maps: Tensor) -> tuple[int, int]:
    return maps.shape[-2], maps.shape[-1]

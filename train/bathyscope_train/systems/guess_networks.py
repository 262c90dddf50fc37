"""The two guesses as networks, so that they can be exported and served like any other system."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bathyscope.model_spec import ResizeSpec, VideoSpec
from bathyscope_train.evaluation.baselines import DARKEST, LUMA
from bathyscope_train.systems.video_networks import VideoNetwork

PATCH = 14
_SIDE = 518
_FOLD = 7
"""Pixels of a frame along a side of a pixel of its folded map, of which a patch has two."""


class Brightness(nn.Module):
    """Depth ~ 1 / sqrt(brightness); see :func:`~bathyscope_train.evaluation.baselines.brightness_depth`."""

    luma: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("luma", torch.tensor(LUMA, dtype=torch.float32)[:, None, None])

    def mixed(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Brightness, folded without loss to the size that the first of the three maps has; the others say nothing."""
        folded = F.pixel_unshuffle((frames * self.luma).sum(1, keepdim=True), _FOLD)
        small = folded[:, :1]
        return folded, small, small.repeat_interleave(2, -2).repeat_interleave(2, -1)

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Tensor:
        """Depth (n, h, w)."""
        del level2, level1
        return F.pixel_shuffle(path3, _FOLD)[:, 0].clamp_min(DARKEST).rsqrt()


class Constant(Brightness):
    """The same depth everywhere."""

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Tensor:
        """Ones (n, h, w)."""
        return torch.ones_like(super().finish(path3, level2, level1))


GUESSES: dict[str, type[Brightness]] = {"constant": Constant, "brightness": Brightness}
"""By the names of :data:`~bathyscope_train.systems.baselines.BASELINES`."""


def guess_network(name: str) -> VideoNetwork:
    """A guess, ready to be exported; it sees pictures like Video Depth Anything does."""
    return VideoNetwork(
        name=name,
        network=GUESSES[name]().eval(),
        spec=VideoSpec(
            quantity="depth",
            scale="relative",
            resize=ResizeSpec(least=(_SIDE, _SIDE), lower_long=True),
            windows=None,
        ),
        patch=PATCH,
        follows_input=True,
        licence="Apache-2.0",
        research_only=False,
    )

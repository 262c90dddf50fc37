"""The Gaussian head: a DPT that also reads the image itself."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import DptHead
from bathyscope_train.model.presets import DptSettings


class GaussianHead(DptHead):
    """Raw parameters of one Gaussian a pixel, and a fusion confidence in the last channel.

    The un-normalised image goes through one wide convolution and is added to the fused features, so that fine
    detail reaches colour and opacity.
    """

    def __init__(self, width: int, settings: DptSettings, *, outputs: int, patch_size: int = 14) -> None:
        super().__init__(width, settings, outputs=outputs, patch_size=patch_size)
        self.input_merger = nn.Sequential(nn.Conv2d(3, settings.features // 2, 7, padding=3), nn.ReLU())

    def forward(self, taps: Sequence[Float[Tensor, "n hw c"]], images: Float[Tensor, "n 3 h w"]) -> Tensor:
        """Raw maps (n, g + 1, h, w) for images in [0, 1]."""
        fused = self.fused(taps, (images.shape[-2], images.shape[-1]))
        return self.finish(fused + self.input_merger(images))

"""EndoDAC's depth network: an adapted Depth Anything with sigmoid disparities at four scales."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.depth_anything.adapters import ENCODER_MLPS, adapt, merge_adapters
from bathyscope_train.systems.depth_anything.disparity import SigmoidPyramid
from bathyscope_train.systems.depth_anything.encoder import Encoder
from bathyscope_train.systems.depth_anything.neck import add_necks
from bathyscope_train.systems.endodac.settings import TAPPED, DepthSettings


class DepthNetwork(nn.Module):
    """Images in [0, 1] of any size to four disparities in (0, 1).

    Images are resized to ``settings.image_size`` (bilinear, corners aligned) and *not* normalised: the adapters were
    trained on plain colours. The head reads the last four blocks.
    """

    def __init__(self, settings: DepthSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = Encoder(
            width=settings.width,
            depth=settings.depth,
            heads=settings.heads,
            taps=range(settings.depth - TAPPED, settings.depth),
            grid=settings.grid,
        )
        add_necks(self.encoder.blocks, settings.neck, grid=settings.token_grid)
        if settings.adapter is not None:
            adapt(self.encoder, ENCODER_MLPS, settings.adapter, rank=settings.rank, scale=settings.adapter_scale)
        self.depth_head = SigmoidPyramid(settings.width, features=settings.features, channels=settings.channels)

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Float[Tensor, "n 1 h2 w2"], ...]:
        """Disparities at 16 times the token grid (256x320), then half, a quarter and an eighth of that."""
        resized = resize_bilinear(images, self.settings.image_size)
        disparities: tuple[Tensor, ...] = self.depth_head(self.encoder(resized), self.settings.token_grid)
        return disparities

    def mixed(self, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """First stage of an exported network: all that :meth:`finish` reads of images in [0, 1]."""
        taps = self.encoder(resize_bilinear(images, self.settings.image_size))
        levels = self.depth_head.levels(taps, self.settings.token_grid)
        path3, _ = self.depth_head.coarse(levels)
        return path3, levels[1], levels[0]

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Float[Tensor, "n h2 w2"]:
        """Second stage, which takes most memory and may run in chunks of images: disparity of the finest scale."""
        return self.depth_head.finish(path3, level2, level1)

    def scaled_disparity(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h2 w2"]:
        """Inverse depth at the finest scale: what published evaluation resizes before it inverts."""
        return self.settings.depth_range.scaled(self.finish(*self.mixed(images)))

    def depth(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h2 w2"]:
        """Depth at the finest scale, relative."""
        return 1 / self.scaled_disparity(images)

    def merge(self) -> DepthNetwork:
        """A copy without adapters and with the same outputs."""
        plain = merge_adapters(self)
        plain.settings = self.settings.model_copy(update={"adapter": None})
        return plain

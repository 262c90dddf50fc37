"""EndoDAV's network: windows of frames to disparities at four scales."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.depth_anything.adapters import ENCODER_MLPS, adapt, merge_adapters
from bathyscope_train.systems.depth_anything.encoder import Encoder
from bathyscope_train.systems.depth_anything.neck import add_necks
from bathyscope_train.systems.endodav.head import HalvedVideoHead, SigmoidVideoHead
from bathyscope_train.systems.endodav.settings import EndoDavSettings
from bathyscope_train.systems.vda.head import through_time
from bathyscope_train.systems.vda.network import normalised

TEMPORAL_LINEARS = ("ff.net.2",)
"""Endings of the names of the temporal modules' layers that are adapted."""


class EndoDav(nn.Module):
    """Frames in [0, 1] of any size to disparities.

    They are resized to ``settings.image_size`` (bilinear, corners aligned) and, unlike EndoDAC's, normalised. Weights
    of Video Depth Anything have the names of its plain parts.
    """

    def __init__(self, settings: EndoDavSettings) -> None:
        super().__init__()
        self.settings = settings
        sizes = settings.network
        self.pretrained = Encoder(
            width=sizes.width,
            depth=sizes.depth,
            heads=sizes.heads,
            taps=sizes.taps,
            grid=sizes.grid,
            patch_size=sizes.patch_size,
            mlp_ratio=sizes.mlp_ratio,
        )
        add_necks(self.pretrained.blocks, settings.neck, grid=settings.token_grid)
        self.head: SigmoidVideoHead | HalvedVideoHead
        if settings.head == "sigmoid":
            self.head = SigmoidVideoHead(sizes)
        else:
            self.head = HalvedVideoHead(sizes, sigmoid=settings.output == "sigmoid")
        if settings.adapter is not None:
            rank, scale = settings.rank, settings.adapter_scale
            adapt(self.pretrained, ENCODER_MLPS, settings.adapter, rank=rank, scale=scale)
            if settings.temporal_adapter:
                adapt(self.head.motion_modules, TEMPORAL_LINEARS, settings.adapter, rank=rank, scale=scale)

    def forward(self, clips: Float[Tensor, "b t 3 h w"]) -> tuple[Float[Tensor, "n 1 h2 w2"], ...]:
        """Disparities of n = b t frames at four scales, fine to coarse; never negative.

        Raises:
            GeometryError: If a clip is longer than the temporal position table (32 frames).
        """
        taps = self._taps(clips.flatten(0, 1))
        disparities: tuple[Tensor, ...] = self.head.window(taps, self.settings.token_grid, clips.shape[1])
        return disparities

    def mixed(self, frames: Float[Tensor, "t 3 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """First stage of an exported network: all that :meth:`finish` reads of the frames of one window."""
        levels = self.head.levels(self._taps(frames), self.settings.token_grid)
        path3, _ = self.head.coarse(levels, through_time(self.head.motion_modules, frames.shape[0]))
        return path3, levels[1], levels[0]

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Float[Tensor, "n h2 w2"]:
        """Second stage, which takes most memory and may run in chunks of frames: disparity of the finest scale."""
        if isinstance(self.head, HalvedVideoHead):
            return self.head.finish(path3, level2, level1, self.settings.image_size)
        return self.head.finish(path3, level2, level1)

    def _taps(self, frames: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        taps: tuple[Tensor, ...] = self.pretrained(normalised(resize_bilinear(frames, self.settings.image_size)))
        return taps

    def disparity(self, clips: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b t h2 w2"]:
        """Disparity of the finest scale."""
        finest: Tensor = self(clips)[0][:, 0]
        return finest.reshape(*clips.shape[:2], *finest.shape[1:])

    def depth(self, clips: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, "b t h2 w2"]:
        """Depth of the finest scale, relative."""
        return self.settings.depth_range.depth(self.disparity(clips))

    def merge(self) -> EndoDav:
        """A copy without adapters and with the same outputs."""
        plain = merge_adapters(self)
        plain.settings = self.settings.model_copy(update={"adapter": None, "temporal_adapter": False})
        return plain

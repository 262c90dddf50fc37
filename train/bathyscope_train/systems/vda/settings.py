"""What a Video Depth Anything network is made of."""

from types import MappingProxyType
from typing import Annotated, Self

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt, model_validator

Repeats = Annotated[int, Field(ge=1, le=128)]


class VdaSettings(BaseModel, frozen=True, extra="forbid"):
    """Sizes of one network; the defaults are those that all published ones share."""

    width: PositiveInt = Field(description="Channels of a token.")
    depth: Repeats = Field(description="Blocks of the encoder.")
    heads: PositiveInt = Field(description="Attention heads of the encoder.")
    taps: tuple[NonNegativeInt, NonNegativeInt, NonNegativeInt, NonNegativeInt] = Field(
        description="Blocks that the head reads, from 0."
    )
    features: PositiveInt = Field(description="Channels of a fused path.")
    channels: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = Field(description="Of levels 1 to 4.")
    grid: PositiveInt = Field(default=37, description="Side of the learnt position table, in patches (518 / 14).")
    patch_size: PositiveInt = 14
    mlp_ratio: PositiveInt = 4
    motion_heads: PositiveInt = Field(default=8, description="Attention heads of a temporal module.")
    motion_groups: PositiveInt = Field(default=32, description="Groups of its GroupNorm.")
    frames: PositiveInt = Field(default=32, description="Length of its position table: the longest window.")

    @model_validator(mode="after")
    def _sizes_fit(self) -> Self:
        if list(self.taps) != sorted(set(self.taps)) or self.taps[-1] >= self.depth:
            raise ValueError(f"taps {self.taps} must rise and stay below the depth of {self.depth} blocks")
        for channels in self.motion_channels:
            if channels % self.motion_heads or channels % self.motion_groups:
                raise ValueError(
                    f"{channels} channels must divide into {self.motion_heads} heads and {self.motion_groups} groups"
                )
        return self

    @property
    def motion_channels(self) -> tuple[int, int, int, int]:
        """Channels of the four temporal modules: on level 3, level 4, path 4 and path 3."""
        return self.channels[2], self.channels[3], self.features, self.features


SIZES = MappingProxyType(
    {
        "s": VdaSettings(width=384, depth=12, heads=6, taps=(2, 5, 8, 11), features=64, channels=(48, 96, 192, 384)),
        "b": VdaSettings(width=768, depth=12, heads=12, taps=(2, 5, 8, 11), features=128, channels=(96, 192, 384, 768)),
        "l": VdaSettings(
            width=1024, depth=24, heads=16, taps=(4, 11, 17, 23), features=256, channels=(256, 512, 1024, 1024)
        ),
    }
)
"""The published networks by the letter of their encoder."""

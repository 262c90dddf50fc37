"""Sizes of EndoDAC's depth network."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Self

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt, model_validator

from bathyscope.depth_range import DepthRange
from bathyscope_train.systems.depth_anything.adapters import AdapterKind

PATCH = 14
TAPPED = 4
Channels = tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt]


class DepthSettings(BaseModel, frozen=True, extra="forbid"):
    """The default is the published network, on Depth Anything ViT-B."""

    width: PositiveInt = 768
    depth: Annotated[int, Field(ge=TAPPED, le=128)] = 12
    heads: PositiveInt = 12
    grid: PositiveInt = Field(default=37, description="Side of the learnt position table, in patches.")
    image_size: tuple[PositiveInt, PositiveInt] = Field(
        default=(224, 280), description="(height, width) that the network resizes its input to."
    )
    features: PositiveInt = Field(default=128, multiple_of=2)
    channels: Channels = (96, 192, 384, 768)
    adapter: AdapterKind | None = Field(default="dvlora", description="Of the two linear layers of every MLP.")
    rank: PositiveInt = 4
    neck: tuple[NonNegativeInt, ...] = Field(default=(2, 5, 8, 11), description="Blocks that a neck follows.")
    depth_range: DepthRange = DepthRange()

    @property
    def token_grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.image_size[0] // PATCH, self.image_size[1] // PATCH

    @property
    def adapter_scale(self) -> float:
        """The factor s = alpha / r of a low-rank adapter: alpha is r for ``dvlora`` and 1 for ``lora``."""
        return 1 / self.rank if self.adapter == "lora" else 1.0

    @model_validator(mode="after")
    def _sizes_fit(self) -> Self:
        if self.width % self.heads:
            raise ValueError(f"width {self.width} does not divide by {self.heads} heads")
        if any(side % PATCH for side in self.image_size):
            raise ValueError(f"image_size {self.image_size} must be multiples of the patch size {PATCH}")
        if any(index >= self.depth for index in self.neck):
            raise ValueError(f"neck {self.neck} names blocks beyond the {self.depth} that there are")
        return self


DEPTH_SETTINGS: Mapping[str, DepthSettings] = MappingProxyType(
    {
        "base": DepthSettings(),
        "small": DepthSettings(width=384, heads=6, features=64, channels=(48, 96, 192, 384)),
    }
)
"""The two encoders that the public project offers."""

"""The option sets of EndoDAV."""

from typing import Literal, Self

from pydantic import BaseModel, Field, NonNegativeInt, PositiveInt, model_validator

from bathyscope.depth_range import DepthRange
from bathyscope_train.systems.depth_anything.adapters import AdapterKind
from bathyscope_train.systems.vda.settings import SIZES, VdaSettings


class EndoDavSettings(BaseModel, frozen=True, extra="forbid"):
    """One option set; the default is the public code's own: ViT-S, DV-LoRA, neck, sigmoid heads.

    The public ``dash`` adapter is not offered: what it computes depends on how often it was called.
    """

    network: VdaSettings = SIZES["s"]
    image_size: tuple[PositiveInt, PositiveInt] = Field(
        default=(224, 280), description="(height, width) that the network resizes its input to."
    )
    adapter: AdapterKind | None = Field(default="dvlora", description="Of the two linear layers of every MLP.")
    temporal_adapter: bool = Field(default=False, description="Whether the temporal modules have adapters, too.")
    rank: PositiveInt = 4
    neck: tuple[NonNegativeInt, ...] = Field(default=(2, 5, 8, 11), description="Blocks that a neck follows.")
    head: Literal["sigmoid", "video"] = Field(
        default="sigmoid",
        description="'sigmoid': four disparities in (0, 1), as in EndoDAC; 'video': Video Depth Anything's output, one "
        "disparity without an upper bound, halved again and again.",
    )
    output: Literal["relu", "sigmoid"] = Field(default="relu", description="Last activation of the 'video' head.")
    depth_range: DepthRange = DepthRange()

    @property
    def token_grid(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        patch = self.network.patch_size
        return self.image_size[0] // patch, self.image_size[1] // patch

    @property
    def adapter_scale(self) -> float:
        """The factor s = alpha / r of a low-rank adapter: alpha is r for ``dvlora`` and 2 r for ``lora``."""
        return 2.0 if self.adapter == "lora" else 1.0

    @model_validator(mode="after")
    def _options_fit(self) -> Self:
        patch = self.network.patch_size
        if any(side % patch for side in self.image_size):
            raise ValueError(f"image_size {self.image_size} must be multiples of the patch size {patch}")
        if any(index >= self.network.depth for index in self.neck):
            raise ValueError(f"neck {self.neck} names blocks beyond the {self.network.depth} that there are")
        if self.temporal_adapter and self.adapter is None:
            raise ValueError("temporal_adapter needs an adapter kind: lora, dvlora or ssb")
        if self.output == "sigmoid" and self.head == "sigmoid":
            raise ValueError("output is an option of the 'video' head; the 'sigmoid' head has its own")
        return self

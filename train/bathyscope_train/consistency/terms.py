"""Settings of the terms of the objective: their factors, and how each is read."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field, NonNegativeFloat, PositiveFloat, PositiveInt

Reduction = Literal["sum", "mean"]


class ImageTerm(BaseModel, frozen=True, extra="forbid"):
    """L_rgb: the rendered image is the frame."""

    weight: NonNegativeFloat = 1.0
    views: Literal["all", "others"] = Field(
        default="all", description="Which Gaussians make a view: all, or those of the other frames."
    )
    divide_by_opacity: bool = Field(default=False, description="So that holes are not dark. Not in the paper.")
    reduction: Reduction = "sum"


class WorldTerm(BaseModel, frozen=True, extra="forbid"):
    """L_3D: depths of one surface point agree."""

    weight: NonNegativeFloat = 1.0
    stride: PositiveInt = 6
    delta: PositiveFloat = Field(default=0.1, description="Of the Huber penalty, relative. Not in the paper.")
    scale_free: bool = Field(default=True, description="Compare logarithms; off, lengths as the paper writes.")
    both_ways: bool = False
    fixed_pixels: bool = Field(
        default=True, description="The valid set is that of the network before training, which cannot be escaped."
    )
    reduction: Reduction = "sum"


class TemporalTerm(BaseModel, frozen=True, extra="forbid"):
    """L_temp: depth edges stay."""

    weight: NonNegativeFloat = 1.0
    kind: Literal["moving", "literal"] = Field(
        default="moving", description="Edges followed by the motion; or pixel by pixel as the paper writes."
    )
    stride: PositiveInt = 6
    scales: PositiveInt = Field(default=4, description="S. Not in the paper.")
    start: float = Field(default=0.0, ge=0, lt=1, description="Share of the run after which it counts.")


class MatchesTerm(BaseModel, frozen=True, extra="forbid"):
    """Points are seen where depth and motion put them; not in the paper, for networks that match."""

    weight: NonNegativeFloat = 0.0
    delta: PositiveFloat = Field(default=0.5, description="Of the Huber penalty, in cells of 4 pixels.")


class AnchorTerm(BaseModel, frozen=True, extra="forbid"):
    """Depth stays near what it was before training; not in the paper."""

    weight: NonNegativeFloat = 0.0


class ObjectiveSettings(BaseModel, frozen=True, extra="forbid"):
    """The terms and their factors; the paper weighs its three terms 1 : 1 : 1."""

    image: ImageTerm = ImageTerm()
    world: WorldTerm = WorldTerm()
    temporal: TemporalTerm = TemporalTerm()
    matches: MatchesTerm = MatchesTerm()
    anchor: AnchorTerm = AnchorTerm()
    depth: Literal["rendered", "placed"] = Field(
        default="rendered",
        description="What L_3D and L_temp compare: depth rendered from the Gaussians of all frames, which one world "
        "makes agree whether it is right or wrong; or the depth at which each frame placed its own.",
    )

    @property
    def weights(self) -> dict[str, float]:
        """Factor of each term."""
        return {
            "image": self.image.weight,
            "world": self.world.weight,
            "temporal": self.temporal.weight,
            "matches": self.matches.weight,
            "anchor": self.anchor.weight,
        }

    @property
    def least_frames(self) -> int:
        """Frames that a window needs for its widest pair."""
        strides = [term.stride for term in (self.world, self.temporal) if term.weight > 0]
        return max([*strides, 1]) + 1

    @property
    def needs_reference(self) -> bool:
        """Whether the network before training takes part."""
        pairs = (self.world.weight > 0 and self.world.fixed_pixels) or (
            self.temporal.weight > 0 and self.temporal.kind == "moving" and self.world.fixed_pixels
        )
        return pairs or self.anchor.weight > 0

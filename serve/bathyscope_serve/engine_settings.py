"""Settings of the depth engine; every result carries the ones it was made with."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from bathyscope.vision.cuts import CutSettings
from bathyscope_serve.decode_limits import DecodeLimits


class StitchSettings(BaseModel, frozen=True, extra="forbid"):
    """When two windows are believed to show one world."""

    rotation_spread_deg: PositiveFloat = Field(
        default=20.0, description="Median disagreement of the shared cameras' rotations that is still an alignment."
    )
    depth_spread: PositiveFloat = Field(
        default=0.5, description="Median absolute deviation of the log depth ratio that is still an alignment."
    )
    least_share: PositiveFloat = Field(default=0.05, description="Share of the pixels that the scale must rest on.")


class PaceSettings(BaseModel, frozen=True, extra="forbid"):
    """How far apart the frames of a window are chosen."""

    motion: PositiveFloat = Field(
        default=0.012, description="Median motion of the picture between key frames, as a share of its width."
    )
    longest: PositiveInt = Field(
        default=5,
        description="Frames after which a key frame follows even if nothing moved; 1 makes windows of neighbours.",
    )


class TrackSettings(BaseModel, frozen=True, extra="forbid"):
    """How points are followed through the video."""

    points: NonNegativeInt = Field(
        default=500, description="Points in a frame; 0 leaves cameras and depth as they are."
    )
    pixels: PositiveInt = Field(default=180_000, description="Largest area of the pictures that they are followed in.")


class RefineSettings(BaseModel, frozen=True, extra="forbid"):
    """How many key frames are adjusted together."""

    step: PositiveInt = Field(default=4, description="New key frames after which there is an adjustment.")
    wait: PositiveInt = Field(default=4, description="Key frames that are adjusted again before they are given out.")
    past: PositiveInt = Field(default=12, description="Key frames before them that hold the world in place.")


class EngineSettings(BaseModel, frozen=True, extra="forbid"):
    """How clips are run through a bundle."""

    threads: PositiveInt | None = Field(default=None, description="Threads of the network; all cores unless given.")
    render_threads: PositiveInt = Field(default=2, description="Frames splatted at the same time.")
    head_chunk: PositiveInt = Field(default=4, description="Frames that the dense heads run on at once.")
    window: PositiveInt | None = Field(default=None, description="Frames of a window; the bundle's unless given.")
    overlap: PositiveInt | None = Field(default=None, description="Shared frames; the bundle's unless given.")
    pixels: PositiveInt | None = Field(default=None, description="Area the network sees; the bundle's unless given.")
    least_opacity: NonNegativeFloat = Field(
        default=0.3, le=1.0, description="Rendered depth below this opacity is replaced by the depth head's."
    )
    pace: PaceSettings = PaceSettings()
    stitch: StitchSettings = StitchSettings()
    tracks: TrackSettings = TrackSettings()
    refine: RefineSettings = RefineSettings()
    cuts: CutSettings = CutSettings()
    decode: DecodeLimits = DecodeLimits()

    @model_validator(mode="after")
    def _windows_advance(self) -> Self:
        if self.window is not None and self.overlap is not None and self.overlap >= self.window:
            raise ValueError(f"overlap ({self.overlap}) must be smaller than window ({self.window})")
        return self

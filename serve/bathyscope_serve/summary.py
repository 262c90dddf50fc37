"""The result without its maps: what a client reads to decide whether it wants them."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field

from bathyscope.camera import Size
from bathyscope.result import FrameDepth, ResultMeta


class FrameSummary(BaseModel, frozen=True):
    """Camera and depth range of one frame."""

    timestamp_s: float
    segment: int
    world_from_camera: list[list[float]] | None = Field(description="Null from a network without cameras.")
    intrinsics: list[list[float]] | None = Field(description="Pixels at source size.")
    valid_fraction: float = Field(description="Part of the frame that has depth.")
    depth_range: tuple[float, float, float] | None = Field(description="5th, 50th and 95th percentile where valid.")


class ClipSummary(BaseModel, frozen=True):
    """Cameras and depth ranges of a clip."""

    size: Size = Field(description="(height, width) of the source.")
    meta: ResultMeta
    frames: list[FrameSummary]


def summarise(frame: FrameDepth) -> FrameSummary:
    """The summary of one finished frame."""
    depth = frame.depth[frame.valid].astype(np.float64)
    low, middle, high = np.percentile(depth, (5, 50, 95)) if depth.size else (0.0, 0.0, 0.0)
    return FrameSummary(
        timestamp_s=frame.timestamp_s,
        segment=frame.segment,
        world_from_camera=None if frame.world_from_camera is None else frame.world_from_camera.tolist(),
        intrinsics=None if frame.intrinsics is None else frame.intrinsics.tolist(),
        valid_fraction=float(frame.valid.mean()),
        depth_range=(float(low), float(middle), float(high)) if depth.size else None,
    )

"""The one interface of all systems: frames (and the camera matrix, where known) in, one estimate a frame out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveInt

from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope.result import DepthKind
from bathyscope.scene import Scene

F32 = NDArray[np.float32]
Quantity = Literal["depth", "disparity"]
Scale = Literal["metric", "relative", "affine"]


class SystemOptions(BaseModel, frozen=True, extra="forbid"):
    """How a system is run; what does not apply to one is refused when it is opened."""

    depth: DepthKind = Field(default="rendered", description="Which depth, of systems that render their scene.")
    input_size: PositiveInt | None = Field(
        default=None, description="Side that a system with a resizing rule of its own resizes to; its own unless given."
    )
    device: Literal["cpu", "cuda"] = "cpu"


class SystemInfo(BaseModel, frozen=True, extra="forbid"):
    """What a system is and what its numbers mean; a table prints it beneath itself."""

    name: str
    quantity: Quantity = Field(description="What ``FrameEstimate.values`` hold.")
    scale: Scale = Field(
        description="'metric': in ``unit``; 'relative': right up to one positive factor for each segment; 'affine': "
        "right up to one positive factor and a shift for each segment."
    )
    unit: Literal["mm", "m"] | None = Field(default=None, description="Of metric depth.")
    confidence: bool = False
    cameras: bool = Field(default=False, description="Whether frames come with poses and intrinsics.")
    gaussians: bool = Field(default=False, description="Whether it is a :class:`SceneSystem`, and gives Gaussians.")
    weights_sha256: str | None = Field(
        default=None, description="Of the checkpoint, or of a bundle's manifest (which names the hash of every file)."
    )
    licence: str | None = Field(default=None, description="Of the weights, where known.")
    details: dict[str, str | int | float] = Field(default_factory=dict, description="Window, sizes, kind of depth ...")


@dataclass(frozen=True, slots=True)
class FrameEstimate:
    """One finished frame, at the size (h, w) of the frames that went in."""

    index: int
    """Number of the frame in the sequence, from 0."""
    values: F32
    """(h, w) depth, or disparity, as ``SystemInfo.quantity`` says; never negative, and finite."""
    valid: NDArray[np.bool_]
    """(h, w) where the values mean something. A disparity of 0 is infinitely far, not invalid."""
    confidence: F32 | None = None
    """(h, w), larger is surer; None if the system has none."""
    world_from_camera: F64 | None = None
    """(4, 4) in the world of the segment's first frame; None if the system has no cameras."""
    intrinsics: F64 | None = None
    """(3, 3) pixels at the size of the frames; None if the system has no cameras."""
    segment: int = 0
    """Frames of one segment share world and scale."""


class System(Protocol):
    """A way to get depth from a video, ready to run."""

    @property
    def info(self) -> SystemInfo:
        """What it is and what its numbers mean."""
        ...

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """Estimates for every frame, in order; memory is bounded by the system's window, not by the clip.

        Args:
            frames: The clip; a frame is read when it is needed, some of them more than once.
            intrinsics: (3, 3) pixels at the size of the frames, for systems that can make use of them.

        Raises:
            BathyscopeError: If a frame cannot be read, or the system cannot work on frames of this size.
        """
        ...


@runtime_checkable
class SceneSystem(System, Protocol):
    """A system that builds a scene of Gaussians on its way to depth, and can hand it out."""

    def scene(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Scene:
        """Cameras (at the size of the frames) and Gaussians of a few frames, seen all at once; memory grows with them.

        Raises:
            SettingsError: If the system has no Gaussians after all; ``info.gaussians`` tells.
        """
        ...

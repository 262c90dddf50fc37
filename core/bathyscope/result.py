"""The result: depth, cameras and what they mean, for every frame of a video.

The same object comes from the service, the client, the command and the library. Its files are in
:mod:`bathyscope.result_files`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from bathyscope.camera import F64, Size
from bathyscope.errors import GeometryError
from bathyscope.model_spec import Output

RESULT_FORMAT = 3
"""Version of the result files; a reader refuses newer ones."""
DepthKind = Literal["rendered", "accumulated", "head"]
"""Where depth comes from."""


class BundleId(BaseModel, frozen=True, extra="forbid"):
    """Which model made a result."""

    name: str
    version: str
    digest: str = Field(description="SHA-256 over the bundle's manifest, which names the hash of every file.")


class PointAgreement(BaseModel, frozen=True, extra="forbid"):
    """How far the network's depth is from points that were followed through the video, before they corrected it.

    An estimate of the depth's error that needs no ground truth, where there is something to follow: it ranks networks
    on the same video, and it is not AbsRel, since points lie where there is texture.
    """

    difference: float = Field(
        ge=0, description="Mean of |depth / depth of the point - 1|, each frame scaled by its median."
    )
    points: float = Field(gt=0, description="Mean number of points in a frame whose depth is certain by their rays.")
    frames: int = Field(gt=0, description="Frames that have enough of them.")


class ResultMeta(BaseModel, frozen=True, extra="forbid"):
    """What the numbers of a result mean and where they come from."""

    format: int = RESULT_FORMAT
    name: str = "clip"
    outputs: tuple[Output, ...] = Field(
        default=("depth", "confidence", "cameras"),
        description="What the result holds. With 'disparity' in the place of 'depth', the array ``depth`` holds "
        "disparity: near is large, 0 is infinitely far.",
    )
    scale: Literal["relative", "mm", "affine"] = Field(
        default="relative",
        description="'relative': right up to one positive factor for each segment of the video; 'affine': up to a "
        "factor and a shift.",
    )
    depth: DepthKind = Field(
        default="rendered",
        description="Rendered from the scene of Gaussians: 'rendered' (expected depth), 'accumulated' (not divided by "
        "opacity: too near wherever the scene is thin); or 'head', the depth head's own.",
    )
    bundle: BundleId | None = None
    software: str = ""
    complete: bool = Field(default=True, description="False: the source ended early or was damaged; see warnings.")
    warnings: tuple[str, ...] = ()
    agreement: PointAgreement | None = Field(
        default=None, description="With followed points; none if there was nothing to follow or no motion to tell by."
    )
    settings: dict[str, Any] = Field(default_factory=dict)
    timings_s: dict[str, float] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FrameDepth:
    """One finished frame, at source size (h, w)."""

    index: int
    """Number of the frame in the source, from 0."""
    timestamp_s: float
    depth: NDArray[np.floating]
    """(h, w) z-depth, 0 where nothing is known; or disparity, where ``ResultMeta.outputs`` says so."""
    confidence: NDArray[np.floating] | None
    """(h, w), larger is surer; 0 outside the field of view. ``None`` from a network that has none."""
    valid: NDArray[np.bool_]
    """(h, w) inside the field of view, with depth."""
    world_from_camera: F64 | None
    """(4, 4) in the world of the segment's first frame; ``None`` from a network without cameras."""
    intrinsics: F64 | None
    """(3, 3) pixels at source size; ``None`` from a network without cameras."""
    segment: int = 0
    """Frames of one segment share one world and one scale."""


@dataclass(frozen=True, slots=True)
class ClipDepth:
    """Depth and cameras of a whole clip; t frames of (h, w) at source size.

    Raises:
        GeometryError: If the arrays do not belong together, or are not those that ``meta.outputs`` names.
    """

    depth: NDArray[np.floating]
    """(t, h, w) z-depth, float32 or float16; 0 where nothing is known. Or disparity, where ``meta.outputs`` says so."""
    confidence: NDArray[np.floating] | None
    """(t, h, w); ``None`` from a network that has none."""
    valid: NDArray[np.bool_]
    """(t, h, w)"""
    world_from_camera: F64 | None
    """(t, 4, 4); the first frame of each segment is the identity. ``None`` from a network without cameras."""
    intrinsics: F64 | None
    """(t, 3, 3) pixels at source size; ``None`` from a network without cameras."""
    timestamps_s: F64
    """(t,) seconds from the start of the source."""
    segment: NDArray[np.int32]
    """(t,) frames of one segment share one world and one scale."""
    meta: ResultMeta

    def __post_init__(self) -> None:
        if self.depth.ndim != 3:
            raise GeometryError(f"depth must be (t, h, w), got shape {self.depth.shape}")
        t, h, w = self.depth.shape
        wanted = {
            "confidence": (t, h, w),
            "valid": (t, h, w),
            "world_from_camera": (t, 4, 4),
            "intrinsics": (t, 3, 3),
            "timestamps_s": (t,),
            "segment": (t,),
        }
        held = array_names(self.meta.outputs)
        for name, shape in wanted.items():
            array = getattr(self, name)
            if (array is not None) != (name in held):
                raise GeometryError(f"meta says outputs {self.meta.outputs}; {name} is {_described(array)}")
            if array is not None and array.shape != shape:
                raise GeometryError(
                    f"{name} beside depth {self.depth.shape} must have shape {shape}, got {array.shape}"
                )

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def size(self) -> Size:
        """(height, width) of the source."""
        return self.depth.shape[1], self.depth.shape[2]

    def frame(self, t: int) -> FrameDepth:
        """One frame of the clip, as a view."""
        return FrameDepth(
            index=t,
            timestamp_s=float(self.timestamps_s[t]),
            depth=self.depth[t],
            confidence=None if self.confidence is None else self.confidence[t],
            valid=self.valid[t],
            world_from_camera=None if self.world_from_camera is None else self.world_from_camera[t],
            intrinsics=None if self.intrinsics is None else self.intrinsics[t],
            segment=int(self.segment[t]),
        )

    @classmethod
    def from_frames(cls, frames: list[FrameDepth], meta: ResultMeta) -> ClipDepth:
        """The clip that finished frames make.

        Raises:
            GeometryError: If there is no frame, their sizes differ, or only some of them have a camera.
        """
        if not frames:
            raise GeometryError("a result needs at least one frame, got none")
        sizes = {frame.depth.shape for frame in frames}
        if len(sizes) > 1:
            raise GeometryError(f"the frames of a result must have one size, got {sorted(sizes)}")
        return cls(
            depth=np.stack([frame.depth for frame in frames]),
            confidence=_stacked([frame.confidence for frame in frames]),
            valid=np.stack([frame.valid for frame in frames]),
            world_from_camera=_stacked([frame.world_from_camera for frame in frames]),
            intrinsics=_stacked([frame.intrinsics for frame in frames]),
            timestamps_s=np.array([frame.timestamp_s for frame in frames], np.float64),
            segment=np.array([frame.segment for frame in frames], np.int32),
            meta=meta,
        )


ARRAY_NAMES = tuple(field.name for field in fields(ClipDepth) if field.name != "meta")
"""Names of the arrays that a result may have, in the order of its files."""
_OPTIONAL: dict[str, Output] = {"confidence": "confidence", "world_from_camera": "cameras", "intrinsics": "cameras"}


def array_names(outputs: tuple[Output, ...]) -> tuple[str, ...]:
    """Names of the arrays of a result with these outputs, in the order of its files."""
    return tuple(name for name in ARRAY_NAMES if name not in _OPTIONAL or _OPTIONAL[name] in outputs)


def _stacked(arrays: list[Any]) -> Any:
    """One array of those of all frames; ``None`` if no frame has one."""
    missing = sum(array is None for array in arrays)
    if missing == len(arrays):
        return None
    if missing:
        raise GeometryError(f"{missing} of {len(arrays)} frames lack what the others have")
    return np.stack(arrays)


def _described(array: NDArray[Any] | None) -> str:
    return "missing" if array is None else f"there, of shape {array.shape}"

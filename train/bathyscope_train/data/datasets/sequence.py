"""One video of a data set, whatever it is stored as: frames, and where they exist true depth and poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.sequences import F32, Crop, Unit

Image = NDArray[np.uint8]
"""RGB (h, w, 3)."""
FRAME_RATE = 25.0
"""Frames a second where the source does not say: the rate of SCARED's videos."""


class FrameReader(Protocol):
    """Where the frames of a video are. Readers travel to worker processes, so they can be pickled."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> Image:
        """A frame.

        Raises:
            DatasetError: If it cannot be read; names the file.
        """
        ...

    def where(self, index: int) -> str:
        """The file of a frame, for messages."""
        ...

    def files(self) -> tuple[Path, ...]:
        """Every file that frames come from."""
        ...


class DepthReader(Protocol):
    """Where the true depth of a video is."""

    def read(self, index: int) -> F32 | None:
        """True z-depth (h, w), 0 where unknown; ``None`` for a frame without any.

        Raises:
            DatasetError: If it cannot be read; names the file.
        """
        ...


@dataclass(frozen=True, eq=False)
class DataSequence:
    """A video; implements :class:`~bathyscope_train.evaluation.sequences.EvaluationSequence` and ``FrameSequence``."""

    name: str
    frames: FrameReader
    frame_names: Sequence[str]
    """One for each frame."""
    size: Size
    """(height, width) of every frame."""
    depth: DepthReader | None = None
    depth_unit: Unit = "arbitrary"
    depth_range: tuple[float, float] | None = None
    """True depths that count, bounds excluded."""
    intrinsics: F64 | None = None
    """(3, 3) at ``size``, origin at the top left corner of the top left pixel."""
    world_from_camera: F64 | None = None
    """(t, 4, 4), NaN for frames without a pose."""
    pose_unit: Unit | None = None
    published_crop: Crop | None = None
    inside: NDArray[np.bool_] | None = None
    """(h, w) the field of view, where the data set states it."""
    groups: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.frame_names) != len(self.frames):
            raise DatasetError(f"{self.name}: {len(self.frame_names)} names for {len(self.frames)} frames")
        if self.world_from_camera is not None and self.world_from_camera.shape != (len(self.frames), 4, 4):
            raise DatasetError(f"{self.name}: poses {self.world_from_camera.shape} for {len(self.frames)} frames")

    def __len__(self) -> int:
        return len(self.frames)

    def time_s(self, index: int) -> float:
        """Seconds from the first frame; data sets state none, so 25 frames a second are assumed."""
        return index / FRAME_RATE

    def image(self, index: int) -> Image:
        """A frame of :attr:`size`.

        Raises:
            DatasetError: If it cannot be read or is of another size; names the file.
        """
        image = self.frames.read(index)
        if image.shape[:2] != self.size:
            (h, w), (height, width) = image.shape[:2], self.size
            raise DatasetError(
                f"{self.frames.where(index)}: {w}x{h} pixels, the other frames of {self.name} have {width}x{height}"
            )
        return image

    def images(self) -> Iterator[Image]:
        """Every frame in order."""
        return (self.image(index) for index in range(len(self)))

    def truth(self, index: int) -> F32 | None:
        """True z-depth in ``depth_unit``, 0 where unknown; ``None`` for a frame without any."""
        return None if self.depth is None else self.depth.read(index)

    def select(self, keep: Sequence[int]) -> DataSequence:
        """The frames ``keep`` alone, in that order."""
        chosen = list(keep)
        return replace(
            self,
            frames=_SomeFrames(self.frames, tuple(chosen)),
            frame_names=[self.frame_names[index] for index in chosen],
            depth=None if self.depth is None else _SomeDepth(self.depth, tuple(chosen)),
            world_from_camera=None if self.world_from_camera is None else self.world_from_camera[chosen],
            groups={name: mask[chosen] for name, mask in self.groups.items()},
        )


@dataclass(frozen=True)
class _SomeFrames:
    source: FrameReader
    keep: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.keep)

    def read(self, index: int) -> Image:
        return self.source.read(self.keep[index])

    def where(self, index: int) -> str:
        return self.source.where(self.keep[index])

    def files(self) -> tuple[Path, ...]:
        return self.source.files()


@dataclass(frozen=True)
class _SomeDepth:
    source: DepthReader
    keep: tuple[int, ...]

    def read(self, index: int) -> F32 | None:
        return self.source.read(self.keep[index])

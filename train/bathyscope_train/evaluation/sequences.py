"""What an evaluation needs of a data set: sequences of frames with true depth, loaded one frame at a time.

A reader of a data set implements :class:`EvaluationSequence` and hands out an :class:`EvaluationSet`; everything that
measures is written against these two. Opening reads names and small files only; pixels are read when they are asked
for, so memory holds one frame whatever the length of a sequence.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size

F32 = NDArray[np.float32]
Unit = Literal["mm", "cm", "m", "arbitrary"]
"""Unit of true depth or of true camera positions; ``arbitrary`` is known up to one factor for the sequence."""
MILLIMETRES: Mapping[Unit, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres in one unit; ``arbitrary`` has none."""


@dataclass(frozen=True, slots=True)
class Crop:
    """A window of image and true depth: rows ``top`` to ``bottom`` and columns ``left`` to ``right``, ends excluded."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True, slots=True)
class Gap:
    """Something that a split or a data set promises and that is not there."""

    sequence: str
    """Name of the sequence."""
    what: str
    """The frame or file that is missing; empty where the whole sequence is."""
    reason: str
    """What was found instead, for people."""


class EvaluationSequence(Protocol):
    """One video with true depth for at least some of its frames."""

    @property
    def name(self) -> str:
        """Unique in its set, like ``dataset8/keyframe0`` or ``rectified17``."""
        ...

    @property
    def frame_names(self) -> Sequence[str]:
        """One name for each frame, in video order, as a split would call it."""
        ...

    @property
    def size(self) -> Size:
        """(height, width) of the images."""
        ...

    @property
    def depth_unit(self) -> Unit:
        """Unit of :meth:`truth`."""
        ...

    @property
    def pose_unit(self) -> Unit | None:
        """Unit of the positions in :attr:`world_from_camera`; ``None`` without poses."""
        ...

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """True depths that count, in ``depth_unit``, bounds excluded; ``None`` for every positive one."""
        ...

    @property
    def intrinsics(self) -> F64 | None:
        """Pixel intrinsics (3, 3) at ``size``; ``None`` where they are not known."""
        ...

    @property
    def world_from_camera(self) -> F64 | None:
        """True poses (t, 4, 4), NaN for frames without one; ``None`` where no frame has one."""
        ...

    @property
    def published_crop(self) -> Crop | None:
        """The window that published per-frame evaluations cut out of image and truth; ``None`` for all of it."""
        ...

    @property
    def groups(self) -> Mapping[str, NDArray[np.bool_]]:
        """Named choices of frames (t,) to report beside all of them, like ``keyframes``; may be empty."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the table must know, like a calibration known to be wrong."""
        ...

    def image(self, index: int) -> NDArray[np.uint8]:
        """A frame as RGB (h, w, 3).

        Raises:
            DatasetError: If it is missing or cannot be read; names the file.
        """
        ...

    def truth(self, index: int) -> F32 | None:
        """True z-depth (H, W) in ``depth_unit``; 0 where unknown, ``None`` for a frame without any.

        Raises:
            DatasetError: If its file should be there and is missing or cannot be read; names the file.
        """
        ...


@dataclass(frozen=True)
class EvaluationSet:
    """The sequences of one data set that an evaluation runs over."""

    name: str
    """Like ``scared``."""
    sequences: tuple[EvaluationSequence, ...]
    split: str
    """Which part of the data set this is, for people: ``video test split``."""
    gaps: tuple[Gap, ...] = field(default=())
    """What the split names and the folder does not hold."""

    @property
    def frame_count(self) -> int:
        """Frames of all sequences."""
        return sum(len(sequence.frame_names) for sequence in self.sequences)

    @property
    def split_hash(self) -> str:
        """First 12 hexadecimal digits of the SHA-256 over all names of sequences and frames, in order."""
        digest = hashlib.sha256()
        for sequence in self.sequences:
            for frame in sequence.frame_names:
                digest.update(f"{sequence.name}\t{frame}\n".encode())
        return digest.hexdigest()[:12]

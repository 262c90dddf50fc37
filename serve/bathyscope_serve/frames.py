"""Frames on their way from a file to the engine, and where they come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.clip import FrameSequence


@dataclass(frozen=True, slots=True)
class Frame:
    """One decoded frame."""

    index: int
    """Number in the source, from 0, counting every frame that could be decoded."""
    timestamp_s: float
    """Presentation time in the source."""
    image: NDArray[np.uint8]
    """(h, w, 3) RGB, upright."""


@dataclass(frozen=True, slots=True)
class Survey:
    """A first look at frames from all over the clip, from which the field of view is read."""

    brightest: NDArray[np.uint8]
    """(h, w) largest value of any channel in any frame looked at."""
    frames: int


@dataclass(slots=True)
class SourceReport:
    """What went wrong while reading, once it is over."""

    complete: bool = True
    """False: the source ended early or was damaged."""
    warnings: list[str] = field(default_factory=list)


class FrameSource(Protocol):
    """Frames of one size in video order, read once."""

    @property
    def name(self) -> str:
        """What to call the clip."""

    @property
    def size(self) -> Size:
        """(height, width) of every frame."""

    @property
    def frame_count(self) -> int | None:
        """Frames that the source says it has: a hint for progress, never a size to allocate."""

    def survey(self) -> Survey:
        """The first look; before, during or after reading."""

    def __iter__(self) -> Iterator[Frame]:
        """The frames.

        Raises:
            ClipError: If a limit is passed on the way.
        """

    def report(self) -> SourceReport:
        """What went wrong so far."""

    def close(self) -> None:
        """Stop reading and free everything."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...


SURVEY_FRAMES = 16


class SequenceSource:
    """A clip in memory, or any other sequence of frames, as a source."""

    def __init__(self, frames: FrameSequence) -> None:
        self._frames = frames

    @property
    def name(self) -> str:
        return self._frames.name

    @property
    def size(self) -> Size:
        return self._frames.size

    @property
    def frame_count(self) -> int | None:
        return len(self._frames)

    def survey(self) -> Survey:
        picked = np.unique(np.linspace(0, len(self._frames) - 1, SURVEY_FRAMES).astype(int))
        brightest = np.zeros(self._frames.size, np.uint8)
        for index in picked:
            np.maximum(brightest, self._frames.image(int(index)).max(2), out=brightest)
        return Survey(brightest, len(picked))

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self._frames)):
            yield Frame(index, self._frames.time_s(index), self._frames.image(index))

    def report(self) -> SourceReport:
        return SourceReport()

    def close(self) -> None:
        """Nothing is held."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

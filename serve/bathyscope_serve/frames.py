"""Frames on their way from a file to the engine, and where they come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.clip import Clip


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


class ClipSource:
    """A clip in memory as a source."""

    def __init__(self, clip: Clip) -> None:
        self._clip = clip

    @property
    def name(self) -> str:
        return self._clip.name

    @property
    def size(self) -> Size:
        return self._clip.size

    @property
    def frame_count(self) -> int | None:
        return len(self._clip)

    def survey(self) -> Survey:
        picked = np.unique(np.linspace(0, len(self._clip) - 1, SURVEY_FRAMES).astype(int))
        return Survey(self._clip.frames[picked].max((0, 3)), len(picked))

    def __iter__(self) -> Iterator[Frame]:
        for index, (image, time) in enumerate(zip(self._clip.frames, self._clip.timestamps_s, strict=True)):
            yield Frame(index, float(time), image)

    def report(self) -> SourceReport:
        return SourceReport()

    def close(self) -> None:
        """Nothing is held."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

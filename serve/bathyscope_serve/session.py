"""One clip on its way through an engine: what all networks have in common."""

from __future__ import annotations

import itertools
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from bathyscope.clip import FrameSequence
from bathyscope.engines import DepthOptions
from bathyscope.errors import BathyscopeError
from bathyscope.model_spec import InputSpec
from bathyscope.result import BundleId, FrameDepth, ResultMeta
from bathyscope.vision.cuts import CutDetector
from bathyscope.vision.field_of_view import FieldOfView, Mask, find_field_of_view
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.frames import FrameSource, SequenceSource
from bathyscope_serve.isolation import open_source
from bathyscope_serve.placed import Sight

Source = Path | str | BinaryIO | FrameSequence | FrameSource


def _unwatched(image: NDArray[np.uint8], cut: bool) -> None:
    """No points are followed."""


class StoppedError(BathyscopeError):
    """The run was closed while it was working."""


@dataclass(frozen=True, slots=True)
class SmallFrame:
    """One frame as the network sees it."""

    index: int
    timestamp_s: float
    image: NDArray[np.float32]
    """(3, h, w) RGB in [0, 1], or a little beyond where it was resized bicubically."""
    sight: Sight | None = None
    """Where the followed points are, if any are followed."""


@dataclass(frozen=True, slots=True)
class Job:
    """What a session works on, and with what."""

    source: Source
    options: DepthOptions
    name: str | None
    bundle: BundleId
    settings: EngineSettings
    input: InputSpec


class DepthSession(ABC):
    """One clip on its way through an engine; see :class:`bathyscope.engines.DepthRun`.

    Args:
        job: What to work on.
        meaning: What the frames hold and what their numbers mean; the rest of it is filled in here.
    """

    def __init__(self, job: Job, meaning: ResultMeta) -> None:
        self._job, self._meaning, self._name = job, meaning, job.name
        self._closed = False
        self._timings: dict[str, float] = {}
        self._complete, self._warnings = True, list[str]()
        self.frame_count: int | None = None
        """Frames that the result will have, as far as the source says; known once iteration has begun."""

    @abstractmethod
    def _estimates(self, source: FrameSource, field_of_view: FieldOfView) -> Iterator[FrameDepth]:
        """Finished frames in order; what is to be said about them goes into ``_warnings``."""

    def __iter__(self) -> Iterator[FrameDepth]:
        begun = time.perf_counter()
        with self._open() as source:
            self._name = source.name
            self.frame_count = _expected(source.frame_count, self._job.options)
            field_of_view = find_field_of_view(source.survey().brightest)
            try:
                yield from self._estimates(source, field_of_view)
            finally:
                report = source.report()
                self._complete = report.complete
                self._warnings = [*report.warnings, *_said(field_of_view), *self._warnings]
                self._timings["total"] = time.perf_counter() - begun

    def meta(self) -> ResultMeta:
        """What the frames mean: known after the last one."""
        known: dict[str, Any] = {
            "name": self._name or "clip",
            "bundle": self._job.bundle,
            "software": f"bathyscope {version('bathyscope')}",
            "complete": self._complete,
            "warnings": tuple(self._warnings),
            "settings": {
                "options": self._job.options.model_dump(),
                "engine": self._job.settings.model_dump(),
                "input": self._job.input.model_dump(),
            },
            "timings_s": {name: round(seconds, 4) for name, seconds in self._timings.items()},
        }
        return self._meaning.model_copy(update=known)

    def close(self) -> None:
        """Stop the work at its next checkpoint; safe from another thread, and to call twice."""
        self._closed = True

    def _open(self) -> FrameSource:
        source = self._job.source
        if isinstance(source, FrameSequence):
            return SequenceSource(source)
        if hasattr(source, "survey"):
            return cast(FrameSource, source)
        with self._timed("decode"):
            return open_source(source, name=self._name, limits=self._job.settings.decode)

    def _frames(
        self,
        source: FrameSource,
        prepare: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
        inside: Mask,
        watch: Callable[[NDArray[np.uint8], bool], Sight | None] = _unwatched,
    ) -> Iterator[tuple[SmallFrame, bool]]:
        """Frames for the network, each with whether it begins a shot.

        Args:
            source: Where they come from.
            prepare: A frame (H, W, 3) to what the network sees (3, h, w).
            inside: (h, w) where it shows something.
            watch: A frame (H, W, 3), and whether it begins a shot, to the points that are followed.
        """
        cuts = CutDetector(self._job.settings.cuts, inside)
        stride, most = self._job.options.stride, self._job.options.max_frames
        frames = itertools.islice(iter(source), 0, None if most is None else (most - 1) * stride + 1, stride)
        while True:
            with self._timed("decode"):
                frame = next(frames, None)
                if frame is None:
                    return
                small = SmallFrame(frame.index, frame.timestamp_s, prepare(frame.image))
                cut = cuts.is_cut(np.clip(small.image, 0, 1))  # bicubic resizing overshoots
            with self._timed("track"):
                sight = watch(frame.image, cut)
            self._checkpoint()
            yield replace(small, sight=sight), cut

    def _checkpoint(self) -> None:
        if self._closed:
            raise StoppedError("the run was closed")

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._timings[part] = self._timings.get(part, 0.0) + time.perf_counter() - begun


def _expected(frames: int | None, options: DepthOptions) -> int | None:
    if frames is None:
        return options.max_frames
    used = -(-frames // options.stride)
    return used if options.max_frames is None else min(used, options.max_frames)


def _said(field_of_view: FieldOfView) -> list[str]:
    """What a reader of the result should know about the field of view."""
    if field_of_view.mask.mean() > 0.25:
        return []
    return [f"the field of view covers only {field_of_view.mask.mean():.0%} of the frame"]

"""The depth engine: a video in, finished frames out, with memory bounded by the window."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from bathyscope.bundle import Bundle, InputSpec
from bathyscope.clip import Clip, FrameSequence
from bathyscope.engines import DepthOptions
from bathyscope.errors import BathyscopeError
from bathyscope.result import ClipDepth, FrameDepth, ResultMeta
from bathyscope.vision.cuts import CutDetector
from bathyscope.vision.field_of_view import FieldOfView, find_field_of_view
from bathyscope.vision.grid import Grid
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.frames import FrameSource, SequenceSource
from bathyscope_serve.isolation import open_source
from bathyscope_serve.runtime import DepthModel, OnnxModel
from bathyscope_serve.stitch import SmallDepth, Stitcher
from bathyscope_serve.window_depth import render_window
from bathyscope_serve.windows import Window, cut_windows

Source = Path | str | BinaryIO | FrameSequence | FrameSource


class StoppedError(BathyscopeError):
    """The run was closed while it was working."""


@dataclass(frozen=True, slots=True)
class SmallFrame:
    """One frame as the network sees it."""

    index: int
    timestamp_s: float
    image: NDArray[np.float32]
    """(3, h, w) RGB in [0, 1]."""


class DepthEngine:
    """A loaded bundle; safe to use from several threads, one run each.

    Args:
        bundle: The model.
        settings: How it is run.
        model: What to run instead of the bundle's graphs.

    Raises:
        BundleError: If ONNX Runtime cannot load the bundle's graphs.
    """

    def __init__(
        self, bundle: Bundle, settings: EngineSettings | None = None, *, model: DepthModel | None = None
    ) -> None:
        self.bundle = bundle
        self.settings = settings or EngineSettings()
        self.model = model or OnnxModel(bundle, self.settings)
        self.input = _input(bundle.manifest.input, self.settings)
        self.renderers = ThreadPoolExecutor(self.settings.render_threads, thread_name_prefix="splat")

    def warm_up(self) -> None:
        """Run a short made-up clip through everything, compiling the splatter on the way."""
        noise = np.random.default_rng(0).integers(0, 255, (2, 64, 80, 3)).astype(np.uint8)
        self.depth_of(Clip(noise, np.array([0.0, 0.04]), "warm-up"))

    def run(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> DepthSession:
        """Begin with a video, a zip or folder of images, an open file, or frames in memory.

        Nothing is read before the session is iterated.
        """
        return DepthSession(self, source, options or DepthOptions(), name)

    def depth_of(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> ClipDepth:
        """The whole result in memory: for short clips.

        Raises:
            ClipError: If the source cannot be used.
        """
        session = self.run(source, options, name=name)
        return ClipDepth.from_frames(list(session), session.meta())


class DepthSession:
    """One clip on its way through an engine; see :class:`bathyscope.engines.DepthRun`."""

    def __init__(self, engine: DepthEngine, source: Source, options: DepthOptions, name: str | None) -> None:
        self._engine, self._source, self._options, self._name = engine, source, options, name
        self._closed = False
        self._timings: dict[str, float] = {}
        self._complete, self._warnings = True, list[str]()
        self.frame_count: int | None = None
        """Frames that the result will have, as far as the source says; known once iteration has begun."""

    def __iter__(self) -> Iterator[FrameDepth]:
        begun = time.perf_counter()
        with self._open() as source:
            self._name = source.name
            self.frame_count = _expected(source.frame_count, self._options)
            field_of_view = find_field_of_view(source.survey().brightest)
            grid = Grid.fit(field_of_view, self._engine.input)
            stitcher = Stitcher(self._engine.input.overlap, self._engine.settings.stitch)
            try:
                for small in self._stitched(source, grid, stitcher):
                    with self._timed("upsample"):
                        frame = _at_source_size(small, grid)
                    yield frame
            finally:
                report = source.report()
                self._complete = report.complete
                self._warnings = [*report.warnings, *_said(field_of_view), *stitcher.warnings]
                self._timings["total"] = time.perf_counter() - begun

    def meta(self) -> ResultMeta:
        """What the frames mean: known after the last one."""
        return ResultMeta(
            name=self._name or "clip",
            depth=self._options.depth,
            bundle=self._engine.bundle.id,
            software=f"bathyscope {version('bathyscope')}",
            complete=self._complete,
            warnings=tuple(self._warnings),
            settings={
                "options": self._options.model_dump(),
                "engine": self._engine.settings.model_dump(),
                "input": self._engine.input.model_dump(),
            },
            timings_s={name: round(seconds, 4) for name, seconds in self._timings.items()},
        )

    def close(self) -> None:
        """Stop the work at its next checkpoint; safe from another thread, and to call twice."""
        self._closed = True

    def _open(self) -> FrameSource:
        source = self._source
        if isinstance(source, FrameSequence):
            return SequenceSource(source)
        if hasattr(source, "survey"):
            return cast(FrameSource, source)
        with self._timed("decode"):
            return open_source(source, name=self._name, limits=self._engine.settings.decode)

    def _stitched(self, source: FrameSource, grid: Grid, stitcher: Stitcher) -> Iterator[SmallDepth]:
        """Frames of the result at the network's size, as they become final."""
        wanted = self._engine.input
        for window in cut_windows(self._frames(source, grid), wanted.window, wanted.overlap):
            depth = self._depth(window, grid)
            with self._timed("stitch"):
                final = list(stitcher.add(depth, window.shared))
            yield from final
        yield from stitcher.finish()

    def _frames(self, source: FrameSource, grid: Grid) -> Iterator[tuple[SmallFrame, bool]]:
        """Frames for the network, each with whether it begins a shot."""
        cuts = CutDetector(self._engine.settings.cuts, grid.inside)
        stride, most = self._options.stride, self._options.max_frames
        frames = itertools.islice(iter(source), 0, None if most is None else (most - 1) * stride + 1, stride)
        while True:
            with self._timed("decode"):
                frame = next(frames, None)
                if frame is None:
                    return
                small = SmallFrame(frame.index, frame.timestamp_s, grid.to_model(frame.image))
                cut = cuts.is_cut(small.image)
            self._checkpoint()
            yield small, cut

    def _depth(self, window: Window[SmallFrame], grid: Grid) -> list[SmallDepth]:
        engine = self._engine
        images = np.stack([frame.image for frame in window.items])
        with self._timed("network"):
            maps = engine.model.predict(images, self._checkpoint)
        with self._timed("splat"):
            views = render_window(
                maps,
                images,
                engine.bundle.manifest.scene,
                inside=grid.inside,
                depth=self._options.depth,
                least_opacity=engine.settings.least_opacity,
                run=engine.renderers.map,
            )
        self._checkpoint()
        return [
            SmallDepth(
                index=frame.index,
                timestamp_s=frame.timestamp_s,
                depth=view.depth,
                confidence=view.confidence,
                known=grid.inside & (view.depth > 0),
                world_from_camera=view.world_from_camera,
                intrinsics=view.intrinsics,
            )
            for frame, view in zip(window.items, views, strict=True)
        ]

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


def _at_source_size(small: SmallDepth, grid: Grid) -> FrameDepth:
    depth, valid = grid.to_source(small.depth, small.known)
    confidence, _ = grid.to_source(small.confidence, small.known)
    return FrameDepth(
        index=small.index,
        timestamp_s=small.timestamp_s,
        depth=depth,
        confidence=confidence,
        valid=valid,
        world_from_camera=small.world_from_camera,
        intrinsics=grid.intrinsics_to_source(small.intrinsics),
        segment=small.segment,
    )


def _input(wanted: InputSpec, settings: EngineSettings) -> InputSpec:
    """The bundle's input with what the settings say otherwise."""
    changed = {"window": settings.window, "overlap": settings.overlap, "pixels": settings.pixels}
    merged = wanted.model_dump() | {name: value for name, value in changed.items() if value is not None}
    return InputSpec.model_validate(merged)


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

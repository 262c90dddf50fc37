"""One clip's estimate, as a worker thread runs it: engine in, result file out, stoppable between frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from bathyscope.camera import Size
from bathyscope.engines import DepthOptions, DepthRun, Engine
from bathyscope.errors import ClipError
from bathyscope.result import FrameDepth, ResultMeta
from bathyscope.result_files import NpzWriter, Precision
from bathyscope.result_zip import write_zip
from bathyscope_serve.negotiation import Form
from bathyscope_serve.summary import ClipSummary, FrameSummary, summarise


class Cancelled(Exception):  # noqa: N818 - an event, not a mistake
    """The estimate was stopped because nobody waits for it any more."""


@dataclass(frozen=True, slots=True)
class Order:
    """What is to be made of which clip."""

    source: Path
    folder: Path
    """Where the result goes; belongs to the request."""
    name: str
    options: DepthOptions
    form: Form
    precision: Precision
    received_s: float
    """How long the body took to arrive; for the timings of the result."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """A finished estimate: a file, or a summary."""

    meta: ResultMeta
    frames: int
    path: Path | None = None
    summary: ClipSummary | None = None


@dataclass
class Estimate:
    """Runs an order once."""

    engine: Engine
    order: Order
    timeout_s: float
    _stop: threading.Event = field(default_factory=threading.Event)
    _run: DepthRun | None = None
    _created: float = field(default_factory=time.monotonic)
    _began: float = 0.0

    def run(self) -> Outcome:
        """Do the work.

        Raises:
            ClipError: If the clip cannot be used, or takes longer than allowed.
            Cancelled: If it was stopped.
        """
        self._began = time.monotonic()
        order = self.order
        with closing(self.engine.run(order.source, order.options, name=order.name)) as run:
            self._run = run
            if order.form == "json":
                return self._summarise(run)
            return self._write(run)

    def cancel(self) -> None:
        """Stop the work as soon as may be; from another thread. It then ends with an error that nobody reads."""
        self._stop.set()
        if self._run is not None:
            self._run.close()

    def _write(self, run: DepthRun) -> Outcome:
        npz = self.order.folder / "result.npz"
        with NpzWriter(npz, self.order.precision) as writer:
            frames = self._drain(run, writer.append)
            meta = self._timed(run.meta())
            writer.close(meta)
        if self.order.form == "npz":
            return Outcome(meta, frames, npz)
        zipped = write_zip(npz, self.order.folder / "result.zip")
        npz.unlink()
        return Outcome(meta, frames, zipped)

    def _summarise(self, run: DepthRun) -> Outcome:
        summaries: list[FrameSummary] = []
        sizes: set[Size] = set()

        def keep(frame: FrameDepth) -> None:
            sizes.add((frame.depth.shape[0], frame.depth.shape[1]))
            summaries.append(summarise(frame))

        frames = self._drain(run, keep)
        meta = self._timed(run.meta())
        return Outcome(meta, frames, summary=ClipSummary(size=sizes.pop(), meta=meta, frames=summaries))

    def _drain(self, run: DepthRun, take: Callable[[FrameDepth], None]) -> int:
        count = 0
        for frame in self._stoppable(run):
            take(frame)
            count += 1
        if count == 0:
            raise ClipError(f"{self.order.name}: no frame could be decoded")
        return count

    def _stoppable(self, run: DepthRun) -> Iterator[FrameDepth]:
        frames = iter(run)
        count = 0
        while not self._stop.is_set():
            frame = next(frames, None)
            if frame is None:
                return
            yield frame
            count += 1
            if time.monotonic() - self._began > self.timeout_s:
                raise ClipError(
                    f"{self.order.name}: {count} frames took longer than {self.timeout_s:g} s, the most one clip may "
                    "take; send a shorter clip or a larger stride"
                )
        raise Cancelled

    def _timed(self, meta: ResultMeta) -> ResultMeta:
        """The engine's meta data with the service's own timings."""
        own = {
            "receive": round(self.order.received_s, 4),
            "queue": round(self._began - self._created, 4),
            "work": round(time.monotonic() - self._began, 4),
        }
        return meta.model_copy(update={"timings_s": {**meta.timings_s, **own}})

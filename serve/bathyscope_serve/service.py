"""The depth service behind the routes: a loaded engine, worker threads, a bounded queue."""

from __future__ import annotations

import asyncio
import math
import shutil
import tempfile
from collections import Counter
from collections.abc import Awaitable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import structlog

from bathyscope.engines import Engine
from bathyscope_serve.estimate import Estimate, Order, Outcome
from bathyscope_serve.problems import ProblemError
from bathyscope_serve.settings import ServiceSettings
from bathyscope_serve.upload import ClientGone

State = Literal["starting", "ready", "failed", "stopping"]
_LONGEST_RETRY_S = 600
_WARM_UP_RETRY_S = 5
_log = structlog.get_logger("bathyscope.serve")


class DepthService:
    """Admits clips, runs them off the event loop, and keeps their temporary files together."""

    def __init__(self, engine: Engine, settings: ServiceSettings) -> None:
        self.engine = engine
        self.settings = settings
        self.state: State = "starting"
        self._pool = ThreadPoolExecutor(settings.workers, thread_name_prefix="estimate")
        self._root: Path | None = None
        self._in_flight: Counter[str] = Counter()
        self._mean_work_s = 1.0
        self._warming: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Make the temporary folder and begin to warm the model up; the service answers meanwhile."""
        self._root = Path(tempfile.mkdtemp(prefix="bathyscope-serve-", dir=self.settings.temp))
        self._warming = asyncio.create_task(self._warm_up())

    async def stop(self) -> None:
        """Wait for running estimates and remove every temporary file."""
        self.state = "stopping"
        await asyncio.to_thread(self._pool.shutdown, wait=True, cancel_futures=True)
        if self._root is not None:
            await asyncio.to_thread(shutil.rmtree, self._root, ignore_errors=True)

    @contextmanager
    def admit(self, client: str) -> Iterator[None]:
        """A place for one clip, from before its body is read until its result is there.

        Raises:
            ProblemError: 503 while the model is not ready or the queue is full, 429 for a client that has too many
                clips in flight; both say when to come back.
        """
        if self.state != "ready":
            raise ProblemError(503, "not-ready", f"the service is {self.state}", headers=_retry(_WARM_UP_RETRY_S))
        limit = self.settings.clips_per_client
        if limit is not None and self._in_flight[client] >= limit:
            raise ProblemError(
                429, "too-many-clips", f"{limit} clips of yours are in flight, the most allowed", headers=self._later()
            )
        places = self.settings.workers + self.settings.queue
        if self._in_flight.total() >= places:
            raise ProblemError(
                503, "queue-full", f"{places} clips are in flight, the most allowed", headers=self._later()
            )
        self._in_flight[client] += 1
        try:
            yield
        finally:
            self._in_flight[client] -= 1
            self._in_flight += Counter()

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """A temporary folder for one request."""
        assert self._root is not None, "the service was not started"
        folder = Path(tempfile.mkdtemp(dir=self._root))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    async def run(self, order: Order, gone: Awaitable[None]) -> Outcome:
        """Estimate a clip in a worker thread.

        Args:
            order: What to do.
            gone: Ends when the client has left; the work then stops at the next frame.

        Raises:
            ClientGone: If the client left.
        """
        estimate = Estimate(self.engine, order, self.settings.work_timeout_s)
        job = self._pool.submit(estimate.run)
        work, watch = asyncio.wrap_future(job), asyncio.ensure_future(gone)
        try:
            ends: set[asyncio.Future[Any]] = {work, watch}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            if not work.done():
                raise ClientGone
            outcome = work.result()
        finally:
            watch.cancel()
            estimate.cancel()
            if not job.cancel():
                await asyncio.gather(asyncio.wrap_future(job), return_exceptions=True)
        self._mean_work_s += 0.3 * (outcome.meta.timings_s["work"] - self._mean_work_s)
        return outcome

    async def _warm_up(self) -> None:
        try:
            await asyncio.get_running_loop().run_in_executor(self._pool, self.engine.warm_up)
        except Exception as error:
            self.state = "failed"
            _log.error("warm_up_failed", exc_info=error)
            return
        if self.state == "starting":
            self.state = "ready"
            _log.info("ready", bundle=self.engine.bundle.id.model_dump())

    def _later(self) -> dict[str, str]:
        """When a place is likely to be free: the mean time of a clip times the clips ahead."""
        waiting_s = self._mean_work_s * self._in_flight.total() / self.settings.workers
        return _retry(min(_LONGEST_RETRY_S, max(1, math.ceil(waiting_s))))


def _retry(seconds: int) -> dict[str, str]:
    return {"Retry-After": str(seconds)}

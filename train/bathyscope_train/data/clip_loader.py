"""Batches of windows, made ahead by worker processes while the trainer works.

The queue is bounded: at most ``ahead`` steps are under way, so memory does not grow when the trainer is the slower one.
Workers give way to it (they run at lower priority) and load no torch.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from types import TracebackType
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope.errors import DatasetError
from bathyscope_train.data.clip_windows import ClipWindows, FrameWindow
from bathyscope_train.data.clip_workers import begin, draw


@dataclass(frozen=True, slots=True)
class FrameBatch:
    """Windows of one step."""

    images: Float[Tensor, "b t 3 h w"]
    inside: Bool[Tensor, "b h w"]
    """Pixels wholly inside the field of view."""
    names: tuple[str, ...]
    indices: tuple[tuple[int, ...], ...]
    intrinsics: Float[Tensor, "b 3 3"] | None
    """Where every window has them."""
    world_from_camera: Float[Tensor, "b t 4 4"] | None
    """Where every window has them; in each data set's unit."""


class WindowLoader:
    """Iterates over the batches of the steps from ``start`` on, for ever. Use it as a context manager.

    Args:
        windows: Where windows come from.
        batch: Windows of this process in a step.
        start: First step: the one to go on with.
        workers: Processes; 0 makes windows in this one, when they are asked for.
        ahead: Steps that are under way at most.
        rank: Number of this process among several that train together.
        world_size: How many of them there are. Together they draw what one process with the whole batch would.
    """

    def __init__(
        self,
        windows: ClipWindows,
        *,
        batch: int = 1,
        start: int = 0,
        workers: int = 2,
        ahead: int = 4,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if not 0 <= rank < world_size:
            raise DatasetError(f"rank {rank} of {world_size} processes")
        self._windows, self._step = windows, start
        self._slots = range(rank * batch, (rank + 1) * batch)
        self._ahead = max(ahead, 1)
        self._queue: deque[list[Future[FrameWindow]]] = deque()
        self._next = start
        self._pool: ProcessPoolExecutor | None = None
        if workers > 0:
            # spawned, not forked: the trainer holds torch's threads
            self._pool = ProcessPoolExecutor(
                workers, mp_context=get_context("spawn"), initializer=begin, initargs=(windows,)
            )

    def __iter__(self) -> Iterator[FrameBatch]:
        while True:
            yield next(self)

    def __next__(self) -> FrameBatch:
        """The batch of the next step.

        Raises:
            DatasetError: If a frame cannot be read any more, or a worker was killed.
        """
        if self._pool is None:
            found = [self._windows.draw(self._step, slot) for slot in self._slots]
        else:
            self._fill()
            try:
                found = [future.result() for future in self._queue.popleft()]
            except BrokenProcessPool as error:
                raise DatasetError(
                    "a process that reads frames was killed, most likely for want of memory; try fewer workers"
                ) from error
            self._fill()
        self._step += 1
        return stack_windows(found)

    @property
    def step(self) -> int:
        """The step whose batch comes next."""
        return self._step

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _fill(self) -> None:
        assert self._pool is not None
        while len(self._queue) < self._ahead:
            try:
                self._queue.append([self._pool.submit(draw, self._next, slot) for slot in self._slots])
            except BrokenProcessPool:
                self._queue.append([])
                raise
            self._next += 1


def stack_windows(windows: list[FrameWindow]) -> FrameBatch:
    """One batch of several windows.

    Raises:
        DatasetError: If they differ in size.
    """
    sizes = {window.frames.shape[2:]: window.name for window in windows}
    if len(sizes) > 1:
        names = ", ".join(f"{name} {w}x{h}" for (h, w), name in sizes.items())
        raise DatasetError(
            f"windows of one batch differ in size ({names}); set `size` for videos of several proportions"
        )
    intrinsics = [window.intrinsics for window in windows if window.intrinsics is not None]
    poses = [window.world_from_camera for window in windows if window.world_from_camera is not None]
    return FrameBatch(
        images=torch.from_numpy(np.stack([window.frames for window in windows])),
        inside=torch.from_numpy(np.stack([window.inside for window in windows])),
        names=tuple(window.name for window in windows),
        indices=tuple(window.indices for window in windows),
        intrinsics=torch.from_numpy(np.stack(intrinsics)).float() if len(intrinsics) == len(windows) else None,
        world_from_camera=torch.from_numpy(np.stack(poses)).float() if len(poses) == len(windows) else None,
    )

"""Clips planned ahead of a renderer, in processes of their own: drawing a scene takes longer than rendering it."""

import logging
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from itertools import count
from multiprocessing import get_context
from typing import NamedTuple

from bathyscope.errors import GeometryError, SettingsError
from bathyscope_train.data.synthetic.clip import ClipPlan, draw_scene, plan_clip
from bathyscope_train.data.synthetic.domain import Domain

_AHEAD = 3  # scenes a process is ahead of the reader

_log = logging.getLogger(__name__)


class PlanJob(NamedTuple):
    """What the plans of one scene are drawn from."""

    domain: Domain
    frames: int
    size: tuple[int, int]
    takes: int
    """Clips of each scene."""


def plan_scene(seed: int, job: PlanJob) -> tuple[list[ClipPlan], list[str]]:
    """The clips of one scene, and why others could not be planned."""
    scene = draw_scene(seed, job.domain)
    plans, failures = [], []
    for take in range(job.takes):
        try:
            plans.append(plan_clip(seed, job.domain, frames=job.frames, size=job.size, take=take, scene=scene))
        except GeometryError as error:
            failures.append(f"domain {job.domain.name}, seed {seed}, take {take}: {error}")
    return plans, failures


class PlanStream:
    """Endless plans, scene after scene, in the order of the seeds whatever the processes do.

    Each scene is used for several clips, with another camera, light and sensor every time, and travels between the
    processes once.
    """

    def __init__(self, job: PlanJob, *, first_seed: int = 0, processes: int = 0) -> None:
        """Start planning.

        Args:
            job: What to plan.
            first_seed: Seeds count up from it.
            processes: Planners beside this process; 0 plans here, when asked.

        Raises:
            SettingsError: If no clip can be planned so.
        """
        if job.takes < 1 or first_seed < 0:
            raise SettingsError(f"a scene is for at least 1 clip and a seed at least 0, got {job.takes}, {first_seed}")
        self.job, self.seeds = job, count(first_seed)
        # Spawned, not forked: this process may hold a device and torch's threads.
        context = get_context("spawn")
        self.pool = ProcessPoolExecutor(processes, mp_context=context) if processes > 0 else None
        self.waiting: deque[Future[tuple[list[ClipPlan], list[str]]]] = deque()
        self.plans = self._plans()
        for _ in range(_AHEAD * processes):
            self._submit()

    def take(self, number: int) -> list[ClipPlan]:
        """The next plans."""
        return [next(self.plans) for _ in range(number)]

    def close(self) -> None:
        """End the processes; no plan can be taken any more."""
        if self.pool is not None:
            self.pool.shutdown(wait=False, cancel_futures=True)

    def _submit(self) -> None:
        assert self.pool is not None
        self.waiting.append(self.pool.submit(plan_scene, next(self.seeds), self.job))

    def _plans(self) -> Iterator[ClipPlan]:
        while True:
            if self.pool is None:
                plans, failures = plan_scene(next(self.seeds), self.job)
            else:
                plans, failures = self.waiting.popleft().result()
                self._submit()
            for failure in failures:
                _log.warning("left out a clip: %s", failure)
            yield from plans

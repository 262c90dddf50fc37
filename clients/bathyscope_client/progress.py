"""Progress of a batch on stderr."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bathyscope_client.clips import LocalClip
from bathyscope_client.runners import OnProgress

_BYTES = ("sending", "receiving")


class BatchProgress:
    """A line for the clip at work; nothing where stderr is no terminal."""

    def __init__(self, clips: int, console: Console | None = None) -> None:
        self._clips = clips
        self._begun = 0
        console = console or Console(stderr=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("[{task.fields[place]}] {task.fields[clip]}: {task.description}", markup=False),
            BarColumn(20),
            TextColumn("{task.fields[amount]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._progress.stop()

    def of(self, clip: LocalClip) -> OnProgress:
        """What hears about one clip; the line of the clip before goes away."""
        for task_id in self._progress.task_ids:
            self._progress.remove_task(task_id)
        self._begun += 1
        task = self._progress.add_task(
            "beginning", total=None, clip=clip.name, place=f"{self._begun}/{self._clips}", amount=""
        )

        def update(stage: str, done: int, total: int | None) -> None:
            amount = f"{done / 1e6:.1f} MB" if stage in _BYTES else f"{done} frames" if done else ""
            self._progress.update(task, description=stage, completed=done, total=total, amount=amount)

        return update

"""The side of :mod:`~bathyscope_train.data.clip_loader` that runs in worker processes; it must not load torch."""

from __future__ import annotations

import os

from bathyscope_train.data.clip_windows import ClipWindows, FrameWindow

_NICENESS = 5
_windows: ClipWindows | None = None
"""What a worker process draws from."""


def begin(windows: ClipWindows) -> None:
    """Begin a worker: one thread, lower priority than the trainer."""
    global _windows  # noqa: PLW0603 - the only way to hand a worker its data once, not with every task
    import cv2

    cv2.setNumThreads(1)
    os.nice(_NICENESS)
    _windows = windows


def draw(step: int, slot: int) -> FrameWindow:
    """The window of one place in the batch of one step."""
    assert _windows is not None
    return _windows.draw(step, slot)

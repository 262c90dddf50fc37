"""Cut a stream of frames into overlapping windows, without knowing how long it is.

Windows have one length wherever the stream is long enough: the last one of a shot is moved back until it is full,
so no window is left with a frame or two.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Window(Generic[T]):
    """Neighbouring items of one shot."""

    items: tuple[T, ...]
    shared: int
    """Leading items that the window before, of the same shot, held too; 0 begins a shot."""


def cut_windows(stream: Iterable[tuple[T, bool]], length: int, overlap: int) -> Iterator[Window[T]]:
    """Windows of ``length`` items that share ``overlap`` with the one before, or more with the last of a shot.

    Args:
        stream: Items, each with whether it begins a new shot; the first does in any case.
        length: Items of a window.
        overlap: Items shared with the window before; smaller than ``length``.
    """
    held: deque[T] = deque(maxlen=length)
    fresh, shot_begun = 0, False
    for item, begins_shot in stream:
        if begins_shot:
            if fresh:
                yield _window(held, fresh, shot_begun)
            held.clear()
            fresh, shot_begun = 0, False
        held.append(item)
        fresh += 1
        if fresh == (length - overlap if shot_begun else length):
            yield _window(held, fresh, shot_begun)
            fresh, shot_begun = 0, True
    if fresh:
        yield _window(held, fresh, shot_begun)


def _window(held: deque[T], fresh: int, shot_begun: bool) -> Window[T]:
    return Window(tuple(held), shared=len(held) - fresh if shot_begun else 0)

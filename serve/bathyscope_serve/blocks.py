"""Cut a stream of frames into blocks of windows whose frames lie apart, without knowing how long the stream is.

Neighbouring frames of slow video show the same view: they say little about distance, and nothing about each other's
errors. So a window takes *key frames*, which lie as far apart as the stream says, and a block is what lies between the
first and the last of them. The frames between the keys share further windows, each spread over the whole block and
tied to its keys::

    frames   p . . . a . . k . . k . . . k . . b      p, a: shared with the block before
    first    p       a     k     k       k     b
    more             a   -     -     -     -   b
                     a -     -     -   -     - b

Every frame is seen once but for the shared ones, as in windows of neighbours: the work is the same. Where every frame
is a key, a block is one window of neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")

_TIES = 2  # frames at least by which a further window hangs on the keys


@dataclass(frozen=True, slots=True)
class Block(Generic[T]):
    """Neighbouring items of one shot, and the windows in which the network sees them."""

    items: tuple[T, ...]
    """The shared ones, which need not be neighbours, then every item since."""
    shared: int
    """Leading items that the block before, of the same shot, held too; 0 begins a shot."""
    windows: tuple[tuple[int, ...], ...]
    """Places in ``items``, rising. The first holds all shared items and the keys; the others some of those, and items
    of their own."""
    kept: int
    """Place of the first item that the next block will share, should the shot go on; the number of items if none."""

    def in_order(self, length: int, overlap: int) -> Iterator[tuple[int, ...]]:
        """The same items in windows of neighbours, for where the others do not fit together; the last one is full."""
        count = len(self.items)
        start = 0
        while start + length < count:
            yield tuple(range(start, start + length))
            start += length - overlap
        yield tuple(range(max(0, min(start, count - length)), count))


def cut_blocks(stream: Iterable[tuple[T, bool, bool]], length: int, overlap: int) -> Iterator[Block[T]]:
    """Blocks whose windows have ``length`` items and whose first windows share ``overlap``, or more at a shot's end.

    Args:
        stream: Items, each with whether it begins a shot (the first does in any case) and whether it is a key.
        length: Items of a window.
        overlap: Key items shared with the block before; smaller than ``length``.
    """
    shot: _Shot[T] = _Shot(length, overlap)
    for item, begins, key in stream:
        if begins:
            yield from shot.rest()
            shot = _Shot(length, overlap)
        shot.add(item, key)
        if shot.full:
            yield shot.block()
    yield from shot.rest()


class _Shot(Generic[T]):
    """A shot as it comes in."""

    def __init__(self, length: int, overlap: int) -> None:
        self._length, self._overlap = length, overlap
        self._ties = max(_TIES, overlap)
        self._carried: tuple[T, ...] = ()
        self._fresh: list[T] = []
        self._keys: list[int] = []

    @property
    def full(self) -> bool:
        """Whether the keys fill a window."""
        return len(self._keys) == self._room

    @property
    def _room(self) -> int:
        return self._length - min(len(self._carried), self._overlap)

    def add(self, item: T, key: bool) -> None:
        """The next item; the first is a key, and so are all where windows are too short to hold anything between."""
        if key or not (self._carried or self._fresh) or self._length <= self._ties:
            self._keys.append(len(self._fresh))
        self._fresh.append(item)

    def rest(self) -> Iterator[Block[T]]:
        """What is left at the end of the shot: its last item is a key, and so are others until a window is full."""
        if not self._fresh:
            return
        last = len(self._fresh) - 1
        keys = sorted({*self._keys, last})
        between = [place for place in range(last) if place not in set(keys)]
        self._keys = sorted(keys + _spread(between, min(len(between), self._room - len(keys))))
        yield self.block()

    def block(self) -> Block[T]:
        """All items since the block before, whose last is a key."""
        shared = min(len(self._carried), self._length - len(self._keys))
        items = (*self._carried[len(self._carried) - shared :], *self._fresh)
        first = (*range(shared), *(shared + key for key in self._keys))
        more = self._more_windows(first, max(shared - 1, 0), len(items))
        kept = first[len(first) - self._overlap] if 0 < self._overlap < len(first) else len(items)
        self._carried = tuple(items[place] for place in first)
        self._fresh, self._keys = [], []
        return Block(items, shared, (first, *more), kept)

    def _more_windows(self, first: tuple[int, ...], start: int, count: int) -> list[tuple[int, ...]]:
        """Windows of the items between the keys, each from the start to the end of the block."""
        between = [place for place in range(start, count) if place not in set(first)]
        inner = [place for place in first if start < place < count - 1]
        windows = -(-len(between) // (self._length - self._ties)) if between else 0
        found = []
        for number in range(windows):
            own = between[number::windows]
            ties = _spread(inner, min(len(inner), self._length - len(own) - 2))
            found.append(tuple(sorted([start, *ties, *own, count - 1])))
        return found


def _spread(values: Sequence[int], count: int) -> list[int]:
    """``count`` of the values, evenly."""
    return [values[(2 * number + 1) * len(values) // (2 * count)] for number in range(count)]

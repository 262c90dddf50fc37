"""Windows of video depth networks: a few key frames of the window before, then frames not seen yet.

The first window holds the first frames of the video. Each later one begins with the frames that stand at the *key
places* of the window before it (so that the video's first frame may be kept for ever), followed by fresh ones. The
stream is padded with its last frame. Nothing needs to know how long the stream is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Generic, Literal, Self, TypeVar

from pydantic import BaseModel, Field, PositiveInt, model_validator

T = TypeVar("T")


class KeyedWindows(BaseModel, frozen=True, extra="forbid"):
    """How windows are cut and how their values are brought together; the defaults are Video Depth Anything's."""

    length: PositiveInt = Field(default=32, le=4096, description="Frames of a window.")
    key_places: tuple[int, ...] = Field(
        default=(0, 12, 24, 25, 26, 27, 28, 29, 30, 31),
        description="Places in a window whose frames begin the next one; the last `blend` are its last places.",
    )
    blend: PositiveInt = Field(default=8, description="Leading frames that are blended with the window before.")
    fit: Literal["references", "blended", "none"] = Field(
        default="references",
        description="What scale and shift of a window are fitted on: 'references', its first frames against maps kept "
        "from earlier (the first of them for ever); 'blended', the blended frames; 'none', nothing: values are metric.",
    )

    @model_validator(mode="after")
    def _places_fit(self) -> Self:
        keys, length, blend = self.key_places, self.length, self.blend
        if not keys or list(keys) != sorted(set(keys)) or keys[0] < 0 or keys[-1] >= length:
            raise ValueError(f"key places {keys} must rise within a window of {length} frames")
        if len(keys) >= length:
            raise ValueError(f"{len(keys)} key frames leave no fresh ones in a window of {length}")
        if keys[-blend:] != tuple(range(length - blend, length)):
            raise ValueError(f"the last {blend} key places must be the last {blend} of the window, got {keys}")
        if self.fit == "references" and len(keys) == blend:
            raise ValueError(f"fitting on references needs more key frames than the {blend} that are blended")
        return self

    @property
    def overlap(self) -> int:
        """Frames of a window that come from the one before."""
        return len(self.key_places)

    @property
    def stride(self) -> int:
        """Fresh frames of a window."""
        return self.length - self.overlap


@dataclass(frozen=True, slots=True)
class KeyedWindow(Generic[T]):
    """Items for one run of the network."""

    items: tuple[T, ...]
    """As many as a window is long; padded with the last item of the stream."""
    fresh: int
    """How many real items come in here for the first time: the first window's leading ones, a later one's after its
    key frames. May be 0 in the last window."""


def keyed_windows(stream: Iterable[T], rule: KeyedWindows) -> Iterator[KeyedWindow[T]]:
    """Windows of a stream of any length; none of an empty one.

    A window is made only when its predecessor does not reach the end of the stream by more than its overlap, as the
    published programs do: a window may hold no fresh item at all and still refine what is blended.
    """
    items = iter(stream)
    window = list(islice(items, rule.length))
    if not window:
        return
    count, start, last = len(window), 0, window[-1]
    yield KeyedWindow(tuple(_padded(window, rule.length, last)), count)
    window = _padded(window, rule.length, last)
    while start + rule.stride < count:
        fresh = list(islice(items, rule.stride))
        count, start = count + len(fresh), start + rule.stride
        last = fresh[-1] if fresh else last
        window = [window[place] for place in rule.key_places] + _padded(fresh, rule.stride, last)
        yield KeyedWindow(tuple(window), len(fresh))


def _padded(items: list[T], length: int, last: T) -> list[T]:
    return items + [last] * (length - len(items))

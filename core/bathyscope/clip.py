"""Frames of one clip: in memory with their time stamps, or read one by one when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import ClipError


@runtime_checkable
class FrameSequence(Protocol):
    """RGB frames of one size in video order, each read when it is asked for; :class:`Clip` is one."""

    @property
    def name(self) -> str:
        """What to call the clip."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of every frame."""
        ...

    def __len__(self) -> int: ...

    def image(self, index: int) -> NDArray[np.uint8]:
        """Frame ``index`` as RGB (h, w, 3).

        Raises:
            BathyscopeError: If it cannot be read, or is not of ``size``.
        """
        ...

    def time_s(self, index: int) -> float:
        """Seconds from the start of the source; never decreasing."""
        ...


@dataclass(frozen=True, slots=True)
class Clip:
    """RGB frames of one size in video order.

    Raises:
        ClipError: If the shapes do not belong together, or there is no frame.
    """

    frames: NDArray[np.uint8]
    """(t, h, w, 3) RGB."""
    timestamps_s: NDArray[np.float64]
    """(t,) seconds from the start of the source; never decreasing."""
    name: str = "clip"

    def __post_init__(self) -> None:
        shape = self.frames.shape
        if self.frames.dtype != np.uint8 or len(shape) != 4 or shape[3] != 3:
            raise ClipError(f"{self.name}: frames must be uint8 (t, h, w, 3), got {self.frames.dtype} {shape}")
        if 0 in shape:
            raise ClipError(f"{self.name}: a clip needs at least one frame and one pixel, got shape {shape}")
        if self.timestamps_s.shape != (shape[0],):
            raise ClipError(f"{self.name}: {shape[0]} frames need as many time stamps, got {self.timestamps_s.shape}")
        if not np.isfinite(self.timestamps_s).all() or (np.diff(self.timestamps_s) < 0).any():
            raise ClipError(f"{self.name}: time stamps must be finite and never decrease")

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.frames.shape[1], self.frames.shape[2]

    def image(self, index: int) -> NDArray[np.uint8]:
        """Frame ``index``, (h, w, 3), as a view."""
        image: NDArray[np.uint8] = self.frames[index]
        return image

    def time_s(self, index: int) -> float:
        """Time stamp of frame ``index`` in seconds."""
        return float(self.timestamps_s[index])

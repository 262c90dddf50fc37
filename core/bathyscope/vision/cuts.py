"""Tell a cut from motion: does a frame show the scene of the one before?"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveFloat

from bathyscope.vision.field_of_view import Mask

_THUMBNAIL = 32
_CELLS = 6
_MEMORY = 12


class CutSettings(BaseModel, frozen=True, extra="forbid"):
    """When two neighbouring frames are taken for different scenes."""

    histogram: PositiveFloat = Field(default=0.45, description="Share of pixels that change their colour cell.")
    correlation: float = Field(default=0.35, description="Correlation of the small grey images below this.")
    surprise: PositiveFloat = Field(default=3.0, description="Times the usual change of the last frames.")


class CutDetector:
    """Compares each frame with the one before.

    A cut changes the colours (histogram), the picture (correlation of small grey images), and both much more than
    the frames before it did; fast motion changes the picture but not the colours, a flash the colours but not
    the picture.

    Args:
        settings: Thresholds.
        inside: (h, w) pixels to look at.
    """

    def __init__(self, settings: CutSettings, inside: Mask) -> None:
        self._settings = settings
        self._inside = inside
        self._weight = cv2.resize(inside.astype(np.float32), (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA)
        self._before: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._usual: deque[float] = deque(maxlen=_MEMORY)

    def is_cut(self, image: NDArray[np.float32]) -> bool:
        """Whether this frame (3, h, w) in [0, 1] begins a new shot; the first never does."""
        now = self._histogram(image), self._thumbnail(image)
        before, self._before = self._before, now
        if before is None:
            return False
        change = 0.5 * float(np.abs(now[0] - before[0]).sum())
        usual = float(np.median(self._usual)) if self._usual else 0.0
        cut = (
            change > self._settings.histogram
            and change > self._settings.surprise * usual
            and self._correlation(now[1], before[1]) < self._settings.correlation
        )
        if cut:
            self._usual.clear()
        else:
            self._usual.append(change)
        return cut

    def _histogram(self, image: NDArray[np.float32]) -> NDArray[np.float64]:
        """Shares of the colour cells."""
        pixels = image[:, self._inside]
        cells = np.minimum((pixels * _CELLS).astype(np.int64), _CELLS - 1)
        index = (cells[0] * _CELLS + cells[1]) * _CELLS + cells[2]
        return np.asarray(np.bincount(index, minlength=_CELLS**3) / index.size, np.float64)

    def _thumbnail(self, image: NDArray[np.float32]) -> NDArray[np.float64]:
        grey = np.ascontiguousarray(image.mean(0))
        return np.asarray(cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA), np.float64)

    def _correlation(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        weight = self._weight / self._weight.sum()
        a, b = a - (weight * a).sum(), b - (weight * b).sum()
        spread = float((weight * a * a).sum() * (weight * b * b).sum())
        return float((weight * a * b).sum()) / max(spread, 1e-12) ** 0.5 if spread > 1e-12 else 1.0

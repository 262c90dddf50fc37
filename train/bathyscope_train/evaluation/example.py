"""One frame of a sequence, small, for a picture that compares systems."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_LONGEST_SIDE = 320


@dataclass(frozen=True)
class Example:
    """The frame, its truth and an aligned prediction, at one size (h, w)."""

    index: int
    image: NDArray[np.uint8]
    """RGB (h, w, 3)."""
    true: NDArray[np.float32]
    """0 where unknown."""
    depth: NDArray[np.float32]
    """0 where nothing was predicted."""

    def save(self, path: Path) -> None:
        """As npz."""
        np.savez(path, index=self.index, image=self.image, true=self.true, depth=self.depth)

    @classmethod
    def load(cls, path: Path) -> Example:
        """The other way round."""
        with np.load(path) as stored:
            return cls(int(stored["index"]), stored["image"], stored["true"], stored["depth"])


def make_example(
    index: int, image: NDArray[np.uint8], true: NDArray[np.float32], depth: NDArray[np.float32]
) -> Example:
    """Shrink so that the longest side has at most 320 pixels; depth by picking pixels, so nothing is blended."""
    import cv2

    h, w = true.shape
    factor = min(1.0, _LONGEST_SIDE / max(h, w))
    size = (max(1, round(w * factor)), max(1, round(h * factor)))
    small = [np.asarray(cv2.resize(m, size, interpolation=cv2.INTER_NEAREST), np.float32) for m in (true, depth)]
    return Example(index, np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), *small)

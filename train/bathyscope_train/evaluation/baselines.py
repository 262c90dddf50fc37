"""Two guesses that need no network; a model that does not beat them has learnt nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of R, G, B in brightness (ITU-R BT.601)."""
DARKEST = 1.0 / 255.0
"""Brightness is not taken below one grey level, where 1 / sqrt would run away."""


def constant_depth(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The same depth everywhere: (h, w) of ones; median scaling turns it into the clip's median depth.

    Args:
        frame: RGB (h, w, 3).
    """
    return np.ones(frame.shape[:2])


def brightness_depth(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Depth as if only the light at the camera's tip, falling off with the square of distance, made the picture.

    Brightness is the luma of the stored values in [0, 1], with no gamma undone: depth ~ 1 / sqrt(brightness).

    Args:
        frame: RGB (h, w, 3).
    """
    brightness = frame.astype(np.float64) @ LUMA / 255.0
    return np.asarray(1.0 / np.sqrt(np.maximum(brightness, DARKEST)), np.float64)

"""How far the picture has moved: the median length of dense optical flow inside the field of view."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.vision.field_of_view import Mask


class MotionMeter:
    """Motion since a picture that was kept, as a share of the picture's width.

    Args:
        inside: (h, w) pixels to look at.
    """

    def __init__(self, inside: Mask) -> None:
        self._inside = inside
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: NDArray[np.uint8] | None = None

    def keep(self, small: NDArray[np.float32]) -> None:
        """Measure from this picture (3, h, w) in [0, 1] from now on."""
        self._before = _grey(small)

    def since(self, small: NDArray[np.float32]) -> float:
        """Motion from the picture that was kept last to this one."""
        assert self._before is not None
        now = _grey(small)
        flow: Any = self._flow.calc(self._before, now, np.zeros((*now.shape, 2), np.float32))
        return float(np.median(np.hypot(flow[..., 0], flow[..., 1])[self._inside]) / small.shape[2])


def _grey(small: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(np.rint(small.mean(0) * 255).clip(0, 255).astype(np.uint8))

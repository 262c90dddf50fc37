"""Bilinear resizing with aligned corners: how video depth networks bring their values to the size of the frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size

F32 = NDArray[np.float32]


def resize_corners(maps: F32, size: Size) -> F32:
    """Maps (..., h, w) at ``size``: the corner pixels keep their values, what lies between is interpolated linearly.

    Rows first, then columns; the same numbers as ``F.interpolate(mode="bilinear", align_corners=True)``.
    """
    if maps.shape[-2:] == size:
        return maps
    top, bottom, down = _samples(maps.shape[-2], size[0])
    left, right, across = _samples(maps.shape[-1], size[1])
    rows = maps[..., top, :] * (1 - down[:, None]) + maps[..., bottom, :] * down[:, None]
    return np.asarray(rows[..., left] * (1 - across) + rows[..., right] * across, np.float32)


def _samples(source: int, target: int) -> tuple[NDArray[np.intp], NDArray[np.intp], F32]:
    """For each target pixel the two source pixels around it, and the share of the second."""
    step = (source - 1) / (target - 1) if target > 1 else 0.0
    places = np.arange(target) * step
    first = np.minimum(places.astype(np.intp), source - 1)
    second = np.minimum(first + 1, source - 1)
    return first, second, (places - first).astype(np.float32)

"""The resizing rules of Depth Anything and its descendants: aspect kept, both sides multiples of the patch.

Depth Anything makes the shorter side what was asked for, and long pictures smaller on the way, so that they cost no
more than a 16:9 one. EndoDAV covers a rectangle.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import ClipError

F32 = NDArray[np.float32]
LONGEST_ASPECT = 1.78
"""Longer over shorter side above which the side asked for is lowered."""
_LOWERED_TO = 1.777


def network_size(frame: Size, side: int, patch: int = 14) -> Size:
    """(height, width) that a network sees of frames of size ``frame``.

    Args:
        frame: (height, width) of the frames.
        side: Wanted shorter side; 518 in the published programs.
        patch: What height and width must be multiples of.

    Raises:
        ClipError: If a frame is so long, or ``side`` so small, that nothing of a patch's height is left.
    """
    aspect = max(frame) / min(frame)
    least = side
    if aspect > LONGEST_ASPECT:
        least = round(int(side * _LOWERED_TO / aspect) / patch) * patch
    if least < patch:
        raise ClipError(f"frames of {frame[0]}x{frame[1]} at side {side} leave less than one patch of {patch} pixels")
    scale = max(least / frame[0], least / frame[1])
    return _to_multiple(scale * frame[0], least, patch), _to_multiple(scale * frame[1], least, patch)


def covering_size(frame: Size, least: Size, patch: int = 14) -> Size:
    """Smallest (height, width) of the frame's aspect, in multiples of the patch, that covers ``least``: EndoDAV's rule.

    Each side is rounded to the nearest multiple, and up where that would be less than ``least`` asks for.

    Args:
        frame: (height, width) of the frames.
        least: (height, width) that neither side may fall below.
        patch: What height and width must be multiples of.
    """
    scale = max(least[0] / frame[0], least[1] / frame[1])
    return _to_multiple(scale * frame[0], least[0], patch), _to_multiple(scale * frame[1], least[1], patch)


def to_network(image: NDArray[np.uint8], size: Size) -> F32:
    """A frame (h, w, 3) as (3, *size), RGB / 255, by OpenCV's bicubic: values may leave [0, 1] and are not clipped."""
    small = cv2.resize(image.astype(np.float32) / 255.0, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(small.transpose(2, 0, 1), np.float32)


def _to_multiple(length: float, least: int, patch: int) -> int:
    """Nearest multiple of the patch, or the next above if that is less than ``least``."""
    nearest = round(length / patch) * patch
    return nearest if nearest >= least else int(np.ceil(length / patch)) * patch

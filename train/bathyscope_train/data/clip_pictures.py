"""A frame as the network sees it, made quickly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.vision.grid import Grid

F32 = NDArray[np.float32]


def to_model_quickly(grid: Grid, image: NDArray[np.uint8]) -> F32:
    """What ``grid.to_model`` gives, rounded to 8 bits, for a fifth of the work: (3, h, w) in [0, 1].

    Args:
        grid: From the source's pixels to the network's.
        image: RGB (H, W, 3) at source size.
    """
    import cv2

    top, left, bottom, right = grid.field_of_view.box
    mask = grid.field_of_view.mask[top:bottom, left:right]
    picture: Any = image[top:bottom, left:right]
    if not mask.all():
        picture = cv2.copyTo(picture, mask.astype(np.uint8), None)
    height, width = grid.size
    smaller = height <= picture.shape[0] and width <= picture.shape[1]
    mode = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    small = cv2.resize(picture, (width, height), interpolation=mode)
    return np.ascontiguousarray(small.transpose(2, 0, 1), np.float32) / np.float32(255)

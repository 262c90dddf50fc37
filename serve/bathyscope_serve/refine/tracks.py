"""Points of the tissue, followed from frame to frame.

Corners are followed by pyramidal Lucas-Kanade in pictures whose contrast is evened out, since the light travels with
the camera. A point is given up where following it back does not end where it began, at highlights, which do not stay
with the tissue, and at the border of the field of view.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.vision.grid import Grid
from bathyscope_serve.engine_settings import TrackSettings
from bathyscope_serve.placed import Sight

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

_WINDOW = 13  # pixels; larger ones straddle steps of depth
_LEVELS = 4
_ENOUGH = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 15, 0.02)
_RETURN = 0.6  # pixels by which a point followed there and back may miss
_BRIGHT = 200  # least channel of a highlight
_SPACING = 9
_QUALITY = 0.003
_LEAST_PIXELS = 60_000  # smaller pictures are enlarged: windows must not hold half of the scene
_FULL = 0.8  # share of the wanted points below which more are looked for


class PointTracker:
    """Follows points through a shot.

    Args:
        grid: Which part of a frame the network sees, and at what size.
        settings: How many points, in pictures of what size.
    """

    def __init__(self, grid: Grid, settings: TrackSettings) -> None:
        self._grid, self._most = grid, settings.points
        height, width = grid.crop_size
        self._size = _followed_size(height, width, settings.pixels)
        top, left, bottom, right = grid.field_of_view.box
        inside = grid.field_of_view.mask[top:bottom, left:right].astype(np.uint8)
        small: Any = cv2.resize(inside, self._size[::-1], interpolation=cv2.INTER_NEAREST)
        framed: Any = cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
        self._inside: U8 = np.asarray(cv2.erode(framed, np.ones((9, 9), np.uint8))[1:-1, 1:-1], np.uint8)
        self._even: Any = cv2.createCLAHE(3.0, (8, 8))
        self._next = 0
        self.forget()

    def forget(self) -> None:
        """Another shot begins: nothing is followed into the next frame."""
        self._before: U8 | None = None
        self._ids, self._points = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)

    def sight(self, image: U8) -> Sight:
        """Where the points are in the next frame (H, W, 3), at source size; lost ones are replaced by others."""
        picture = self._cropped(image)
        now: U8 = np.asarray(self._even.apply(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)), np.uint8)
        usable = self._usable(picture)
        if self._before is not None and len(self._points):
            self._follow(self._before, now, usable)
        if len(self._points) < _FULL * self._most:
            self._refill(now, usable)
        self._before = now
        scale = np.array(self._grid.size[::-1]) / np.array(self._size[::-1])
        places = ((self._points + 0.5) * scale).astype(np.float32)
        return Sight(self._ids, places, float(np.sqrt(scale[0] * scale[1])))

    def _cropped(self, image: U8) -> U8:
        top, left, bottom, right = self._grid.field_of_view.box
        crop = np.ascontiguousarray(image[top:bottom, left:right])
        if crop.shape[:2] == self._size:
            return crop
        mode = cv2.INTER_AREA if crop.shape[0] > self._size[0] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(crop, self._size[::-1], interpolation=mode), np.uint8)

    def _usable(self, picture: U8) -> U8:
        """255 where there may be points."""
        red, green, blue = cv2.split(picture)
        _, bright = cv2.threshold(cv2.min(cv2.min(red, green), blue), _BRIGHT, 255, cv2.THRESH_BINARY)
        bright = cv2.dilate(bright, np.ones((9, 9), np.uint8))
        return np.where((self._inside > 0) & (bright == 0), np.uint8(255), np.uint8(0))

    def _follow(self, before: U8, now: U8, usable: U8) -> None:
        there, found = _flow(before, now, self._points)
        back, returned = _flow(now, before, there)
        height, width = now.shape
        nearest = np.rint(there).astype(int)
        inside = ((nearest >= 0) & (nearest < (width, height))).all(1)
        column, row = nearest[:, 0].clip(0, width - 1), nearest[:, 1].clip(0, height - 1)
        kept = found & returned & inside & (usable[row, column] > 0)
        kept &= np.linalg.norm(back - self._points, axis=1) < _RETURN
        self._ids, self._points = self._ids[kept], there[kept]

    def _refill(self, now: U8, usable: U8) -> None:
        free = usable.copy()
        for column, row in np.rint(self._points).astype(int).tolist():
            cv2.circle(free, (column, row), _SPACING, 0, -1)
        corners: Any = cv2.goodFeaturesToTrack(now, self._most - len(self._points), _QUALITY, _SPACING, mask=free)
        if corners is None:
            return
        fresh = np.asarray(corners, np.float32).reshape(-1, 2)
        self._points = np.concatenate([self._points, fresh])
        self._ids = np.concatenate([self._ids, np.arange(self._next, self._next + len(fresh))])
        self._next += len(fresh)


def _followed_size(height: int, width: int, most: int) -> Size:
    """Smaller than the source where that is large, up to twice its size where that is very small."""
    area = height * width
    factor = max(np.sqrt(min(1.0, most / area)), min(2.0, np.sqrt(_LEAST_PIXELS / area)))
    return max(16, round(height * factor)), max(16, round(width * factor))


def _flow(source: U8, target: U8, points: F32) -> tuple[F32, NDArray[np.bool_]]:
    """Points (n, 2) in the target picture, and which of them were found."""
    moved: Any
    status: Any
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        points,
        np.zeros_like(points),
        winSize=(_WINDOW, _WINDOW),
        maxLevel=_LEVELS,
        criteria=_ENOUGH,
    )
    return np.asarray(moved, np.float32).reshape(-1, 2), np.asarray(status).ravel() == 1

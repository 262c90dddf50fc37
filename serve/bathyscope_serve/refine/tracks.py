"""Points of the tissue, followed from frame to frame.

Corners are followed by pyramidal Lucas-Kanade in pictures whose contrast is evened out, since the light travels with
the camera. A point is given up where following it back does not end where it began, at highlights, which do not stay
with the tissue, and at the border of the field of view. Where most are lost at once or the picture is blurred, those of
the frame before are looked for again in the frames after it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.vision.field_of_view import BLACK
from bathyscope.vision.grid import Grid
from bathyscope_serve.engine_settings import TrackSettings
from bathyscope_serve.placed import Sight

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
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
_LOST = 0.5  # share of the points that a frame must keep not to be taken for one that shows nothing
_LEAST = 20  # points that come back
_PATIENCE = 6  # frames
_BLURRED = 0.7  # of the sharpness before: what is followed through such a frame comes out beside where it went in


@dataclass(frozen=True, slots=True)
class _View:
    """A frame as it is followed."""

    picture: U8
    usable: U8
    """255 where there may be points."""
    sharpness: float

    def is_blurred(self, before: _View) -> bool:
        """Whether much less can be seen in it than before."""
        return self.sharpness < _BLURRED * before.sharpness


@dataclass(frozen=True, slots=True)
class _Seen:
    """Points in a picture."""

    view: _View
    ids: I64
    points: F32


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
        self._last: _Seen | None = None
        self._behind: _Seen | None = None
        """The last frame before most points were lost."""
        self._patience = 0

    def sight(self, image: U8) -> Sight:
        """Where the points are in the next frame (H, W, 3), at source size; lost ones are replaced by others."""
        picture = self._cropped(image)
        now: U8 = np.asarray(self._even.apply(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)), np.uint8)
        seen = self._kept(_View(now, self._usable(picture), _sharpness(now)))
        if len(seen.ids) < _FULL * self._most:
            seen = self._refilled(seen)
        self._last = seen
        scale = np.array(self._grid.size[::-1]) / np.array(self._size[::-1])
        places = ((seen.points + 0.5) * scale).astype(np.float32)
        return Sight(seen.ids, places, float(np.sqrt(scale[0] * scale[1])))

    def _kept(self, now: _View) -> _Seen:
        """The points that are still seen, or seen again."""
        if self._last is None:
            return _Seen(now, np.zeros(0, np.int64), np.zeros((0, 2), np.float32))
        last, behind = self._last, self._behind
        kept = _followed(last, now)
        begins = now.is_blurred(last.view) and (behind is None or not last.view.is_blurred(behind.view))
        if behind is not None:
            kept = self._brought_back(kept, behind)
        if begins or (behind is None and len(kept.ids) < _LOST * len(last.ids)):
            self._behind, self._patience = last, _PATIENCE
        return kept

    def _brought_back(self, kept: _Seen, behind: _Seen) -> _Seen:
        """With the points of an earlier frame, if more of them are found from there than through the frames between."""
        back = _followed(behind, kept.view)
        found = len(back.ids) > max(_LEAST, np.isin(kept.ids, behind.ids).sum())
        self._patience -= 1
        if self._patience == 0 or (found and not kept.view.is_blurred(behind.view)):
            self._behind = None
        return _united(back, kept, behind.ids, self._most) if found else kept

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
        lit = np.asarray(cv2.max(cv2.max(red, green), blue)) > BLACK
        return np.where((self._inside > 0) & (bright == 0) & lit, np.uint8(255), np.uint8(0))

    def _refilled(self, seen: _Seen) -> _Seen:
        free = seen.view.usable.copy()
        for column, row in np.rint(seen.points).astype(int).tolist():
            cv2.circle(free, (column, row), _SPACING, 0, -1)
        wanted = self._most - len(seen.ids)
        corners: Any = cv2.goodFeaturesToTrack(seen.view.picture, wanted, _QUALITY, _SPACING, mask=free)
        if corners is None:
            return seen
        points = np.asarray(corners, np.float32).reshape(-1, 2)
        ids = np.arange(self._next, self._next + len(points))
        self._next += len(points)
        return _Seen(seen.view, np.concatenate([seen.ids, ids]), np.concatenate([seen.points, points]))


def _sharpness(picture: U8) -> float:
    """Of what is larger than noise."""
    half = np.asarray(cv2.pyrDown(picture))
    return float(np.abs(np.asarray(cv2.Laplacian(half, cv2.CV_16S, ksize=3))).mean())


def _united(back: _Seen, kept: _Seen, known: I64, most: int) -> _Seen:
    """Points that came back, and as many that were found since as there is room for."""
    new = np.flatnonzero(~np.isin(kept.ids, known))[: max(0, most - len(back.ids))]
    ids = np.concatenate([back.ids, kept.ids[new]])
    order = np.argsort(ids)
    return _Seen(back.view, ids[order], np.concatenate([back.points, kept.points[new]])[order])


def _followed(seen: _Seen, now: _View) -> _Seen:
    """What is found of the points in another picture."""
    if not len(seen.ids):
        return _Seen(now, seen.ids, seen.points)
    there, found = _flow(seen.view.picture, now.picture, seen.points)
    back, returned = _flow(now.picture, seen.view.picture, there)
    height, width = now.picture.shape
    nearest = np.rint(there).astype(int)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(1)
    column, row = nearest[:, 0].clip(0, width - 1), nearest[:, 1].clip(0, height - 1)
    kept = found & returned & inside & (now.usable[row, column] > 0)
    kept &= np.linalg.norm(back - seen.points, axis=1) < _RETURN
    return _Seen(now, seen.ids[kept], there[kept])


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

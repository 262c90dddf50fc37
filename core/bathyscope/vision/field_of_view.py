"""Where in the frame the endoscope's picture is: black borders, round and cut-off masks.

What never gets bright in any frame that was looked at and hangs together with a corner of the picture lies outside. A
dark lumen does not reach the corners, so it stays inside however dark it is. The outline is then replaced by
the simplest shape that explains it: the whole frame, a rectangle, a circle, or the convex hull.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size

Mask = NDArray[np.bool_]
Shape = Literal["full", "rectangle", "round", "hull"]

DARK = 28
"""Largest value of a channel in what counts as black: borders of real videos stay below 20 with their noise."""
BLACK = 8
"""Largest value of a channel in what shows nothing but noise."""
_SMALLEST_OUTSIDE = 0.004
"""Share of the frame below which a dark corner is taken for shadow."""
_SMALLEST_INSIDE = 0.05
_BAR_DARK = 0.985
"""Share of a row or column that must be black to count as border."""


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """The part of a frame that shows something."""

    mask: Mask
    """(h, w) at source size; true inside."""
    shape: Shape

    @property
    def box(self) -> tuple[int, int, int, int]:
        """(top, left, bottom, right) around the inside; bottom and right are exclusive."""
        rows, columns = np.flatnonzero(self.mask.any(1)), np.flatnonzero(self.mask.any(0))
        return int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1


@dataclass(frozen=True, slots=True)
class Circle:
    """In pixels, with the centre of the first pixel at (0.5, 0.5)."""

    x: float
    y: float
    radius: float

    def mask(self, size: Size, margin: float = 0.0) -> Mask:
        """Pixels whose centre lies inside by at least ``margin``."""
        y, x = np.ogrid[: size[0], : size[1]]
        return np.asarray((x + 0.5 - self.x) ** 2 + (y + 0.5 - self.y) ** 2 <= max(self.radius - margin, 0) ** 2)


def find_field_of_view(brightest: NDArray[np.uint8]) -> FieldOfView:
    """The field of view of a clip.

    Args:
        brightest: (h, w) largest value of any channel in any of several frames.
    """
    size: Size = (brightest.shape[0], brightest.shape[1])
    full = FieldOfView(np.ones(size, np.bool_), "full")
    dark = cv2.medianBlur(np.ascontiguousarray(brightest), 5) < DARK
    bars = _bars(dark)
    if bars is None:
        return full  # black from edge to edge: nothing to tell an outside by
    top, left, bottom, right = bars
    picture = dark[top:bottom, left:right]
    inside = _inside(picture)
    shape: Shape = "full" if picture.shape == dark.shape else "rectangle"
    outside = 1 - inside.mean()
    if _SMALLEST_OUTSIDE < outside < 1 - _SMALLEST_INSIDE:
        circle = fit_circle(inside)
        margin = max(1.5, 0.01 * min(size))  # the rim of a lens glows
        if circle is not None:
            inside, shape = circle.mask(picture.shape, margin), "round"
        else:
            inside, shape = _hull(inside, margin), "hull"
    elif outside <= _SMALLEST_OUTSIDE:
        inside = np.ones_like(inside)
    else:
        return full
    mask = np.zeros(size, np.bool_)
    mask[top:bottom, left:right] = inside
    return FieldOfView(mask, shape)


def fit_circle(inside: Mask) -> Circle | None:
    """The circle whose disc, cut by the frame, is ``inside`` but for dark bites at its rim; ``None`` if it is none."""
    points = _rim(inside)
    if len(points) < 24:
        return None
    circle = _robust_circle(points)
    if circle is None:
        return None
    h, w = inside.shape
    reach = max(h, w)
    tolerance = max(2.0, 0.012 * circle.radius)
    distance = np.abs(np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) - circle.radius)
    disc = circle.mask((h, w))
    in_frame = disc.mean() * h * w
    fits = (
        (distance < tolerance).mean() > 0.6
        and 0.25 * min(h, w) < circle.radius < 1.2 * reach
        and (inside & ~circle.mask((h, w), -2 * tolerance)).sum() < 0.01 * inside.sum()
        and (inside & disc).sum() > 0.75 * in_frame
    )
    return circle if fits else None


def _bars(dark: Mask) -> tuple[int, int, int, int] | None:
    """Box inside the bars that are black from edge to edge."""
    rows = np.flatnonzero(dark.mean(1) < _BAR_DARK)
    if len(rows) == 0:
        return None
    top, bottom = rows[0], rows[-1] + 1
    columns = np.flatnonzero(dark[top:bottom].mean(0) < _BAR_DARK)
    if len(columns) == 0:
        return None
    left, right = columns[0], columns[-1] + 1
    if (bottom - top) * (right - left) < _SMALLEST_INSIDE * dark.size:
        return None
    return int(top), int(left), int(bottom), int(right)


def _inside(dark: Mask) -> Mask:
    """The largest area that is not black out to a corner, with its holes filled."""
    _, labels = cv2.connectedComponents(dark.astype(np.uint8), connectivity=4)
    corners = {int(labels[y, x]) for y in (0, -1) for x in (0, -1)} - {0}
    outside = np.isin(labels, list(corners))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    lit = cv2.morphologyEx((~outside).astype(np.uint8), cv2.MORPH_OPEN, kernel)  # cuts off text and lines
    count, labels, stats, _ = cv2.connectedComponentsWithStats(lit, connectivity=4)
    if count < 2:
        return np.zeros_like(dark)
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])))


def _rim(inside: Mask) -> NDArray[np.float64]:
    """(n, 2) points of the outline that do not lie on the edge of the frame."""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.zeros((0, 2))
    points = max(contours, key=len)[:, 0].astype(np.float64) + 0.5
    h, w = inside.shape
    edge = 2.0
    free = (points[:, 0] > edge) & (points[:, 0] < w - edge) & (points[:, 1] > edge) & (points[:, 1] < h - edge)
    return np.asarray(points[free])


def _robust_circle(points: NDArray[np.float64]) -> Circle | None:
    """Best of 200 circles through three rim points, refined on the points that agree with it."""
    random = np.random.default_rng(0)
    best, most = None, 0
    for _ in range(200):
        circle = _least_squares(points[random.choice(len(points), 3, replace=False)])
        if circle is None:
            continue
        agreeing = _agreeing(points, circle)
        if agreeing.sum() > most:
            best, most = circle, int(agreeing.sum())
    for _ in range(3):
        if best is None:
            return None
        best = _least_squares(points[_agreeing(points, best)])
    return best


def _agreeing(points: NDArray[np.float64], circle: Circle) -> Mask:
    distance = np.abs(np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) - circle.radius)
    return np.asarray(distance < max(1.5, 0.006 * circle.radius))


def _least_squares(points: NDArray[np.float64]) -> Circle | None:
    """Algebraic fit: x² + y² = 2 a x + 2 b y + c."""
    centre = points.mean(0)
    x, y = (points - centre).T
    matrix = np.stack([2 * x, 2 * y, np.ones_like(x)], 1)
    (a, b, c), _, rank, _ = np.linalg.lstsq(matrix, x * x + y * y, rcond=None)
    square = c + a * a + b * b
    if rank < 3 or square <= 0:
        return None
    return Circle(float(a + centre[0]), float(b + centre[1]), float(np.sqrt(square)))


def _hull(inside: Mask, margin: float) -> Mask:
    """Convex hull, drawn in by the margin where it does not lie on the edge of the frame."""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = np.zeros(inside.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(contours)), 1)
    side = 2 * int(np.ceil(margin)) + 1
    return np.asarray(cv2.erode(hull, np.ones((side, side), np.uint8), borderValue=1) > 0)

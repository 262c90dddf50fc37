r"""A smooth correction of one frame's depth: what points say whose place is known, and no more than they say.

.. math:: \log z = \log d + a + b u + c v + g (\log d - m)

with u and v from -1 to 1 across the picture, and m the median of log d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size

F32 = NDArray[np.float32]

_SPREAD = np.array([1.0, 0.1, 0.1, 0.03])
"""Standard deviations of a, b, c and g around those of the frame before, and 0."""
_LARGEST = np.array([np.inf, 0.4, 0.4, 0.2])
_LEAST_NOISE = 0.03
_TRUST = 2.0  # errors of points are larger than their doubt: cameras are off, too
_WORTH = 60  # independent points at most: neighbours say the same
_LEAST = 8
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class DepthField:
    """The correction of a frame."""

    values: F64
    """(4,) a, b, c, g."""
    middle: float
    """m"""

    @property
    def scale(self) -> float:
        """The factor at the middle of the picture."""
        return float(np.exp(self.values[0]))

    def applied(self, depth: F32, known: NDArray[np.bool_]) -> F32:
        """The depth map (h, w), corrected where it is known."""
        height, width = depth.shape
        u = (np.arange(width) + 0.5) / width * 2 - 1
        v = (np.arange(height) + 0.5) / height * 2 - 1
        own = np.log(np.where(known & (depth > 0), depth, 1.0))
        a, b, c, g = self.values
        factor = np.exp(a + b * u + c * v[:, None] + g * (own - self.middle))
        return np.where(known, depth * factor, depth).astype(np.float32)


def plain_field(scale: float) -> DepthField:
    """A factor for the whole picture."""
    return DepthField(np.array([np.log(scale), 0.0, 0.0, 0.0]), 0.0)


@dataclass(frozen=True, slots=True)
class KnownDepths:
    """n points of a frame whose depth is known."""

    places: F64
    """(n, 2) pixels"""
    own: F64
    """(n,) log depth that the frame has there."""
    found: F64
    """(n,) log depth of the points."""
    doubt: F64
    """(n,) standard deviation of ``found``."""


def fit_field(points: KnownDepths, size: Size, before: DepthField) -> DepthField:
    """The field that carries the frame's depths to those of the points.

    Args:
        points: What is known.
        size: (height, width) of the picture.
        before: Of the frame before; the answer where there are too few points.
    """
    places, own = points.places, points.own
    if len(own) < _LEAST:
        return before
    middle = float(np.median(own))
    terms = np.stack(
        [np.ones(len(own)), places[:, 0] / size[1] * 2 - 1, places[:, 1] / size[0] * 2 - 1, own - middle], 1
    )
    wanted = points.found - own
    worth = min(1.0, _WORTH / len(own))
    values = np.array([np.median(wanted), 0.0, 0.0, 0.0])
    prior, expected = np.diag(1 / _SPREAD**2), np.array([before.values[0], 0.0, 0.0, 0.0])
    for _ in range(_ROUNDS):
        off = wanted - terms @ values
        noise = max(1.4826 * float(np.median(np.abs(off))), _LEAST_NOISE)
        variance = noise**2 + (_TRUST * points.doubt) ** 2
        share = worth / (1 + off**2 / (4 * variance)) / variance
        values = np.linalg.solve(
            terms.T @ (terms * share[:, None]) + prior, terms.T @ (share * wanted) + prior @ expected
        )
    return DepthField(np.clip(values, -_LARGEST, _LARGEST), middle)

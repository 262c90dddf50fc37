r"""A smooth correction of one frame's depth: what points say whose place is known, and no more than they say.

.. math:: \log z = \log d + a + b u + c v + g (\log d - m) + \sum_{ij} h_{ij} \beta_i(v) \beta_j(u)

with u and v from -1 to 1 across the picture, m the median of log d, and Gaussian bumps β about a grid of six by six
places. Each value has a prior around 0, so the field falls back to the plainer terms where there are no points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size

F32 = NDArray[np.float32]

_GRID = np.linspace(-0.9, 0.9, 6)
_WIDTH = 0.8 * (_GRID[1] - _GRID[0])
_PLAIN = 4
LEAST_POINTS = 8
"""Below that, a frame keeps what is expected of it."""
_SPREAD = np.concatenate([[1.0, 0.1, 0.1, 0.03], np.full(_GRID.size**2, 0.06)])
"""Standard deviations before anything is known; of a around that of the frame before, of the others around 0."""
_KEPT = np.concatenate([[1.0], np.full(len(_SPREAD) - 1, 0.8)])
"""How much of a frame's values is left in the next if that has no points."""
_MOST = np.concatenate([[np.inf], np.full(_PLAIN - 1 + _GRID.size**2, 0.4)])
_LEAST_NOISE = 0.03
_TRUST = 2.0  # errors of points are larger than their doubt: cameras are off, too
_WORTH = 200  # independent points at most: neighbours say the same
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class DepthField:
    """The correction of a frame."""

    values: F64
    """(40,) a, b, c, g, then h row by row."""
    middle: float
    """m"""

    @property
    def scale(self) -> float:
        """The factor at the middle of the picture, but for the bumps."""
        return float(np.exp(self.values[0]))

    def at_scale(self, scale: float) -> DepthField:
        """The same with another factor."""
        return DepthField(np.concatenate([[np.log(scale)], self.values[1:]]), self.middle)

    def applied(self, depth: F32, known: NDArray[np.bool_]) -> F32:
        """The depth map (h, w), corrected where it is known."""
        height, width = depth.shape
        u = (np.arange(width) + 0.5) / width * 2 - 1
        v = (np.arange(height) + 0.5) / height * 2 - 1
        own = np.log(np.where(known & (depth > 0), depth, 1.0))
        a, b, c, g = self.values[:_PLAIN]
        local = _bumps(v) @ self.values[_PLAIN:].reshape(_GRID.size, _GRID.size) @ _bumps(u).T
        factor = np.exp(a + b * u + c * v[:, None] + g * (own - self.middle) + local)
        return np.where(known, depth * factor, depth).astype(np.float32)


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


def plain_field(scale: float) -> DepthField:
    """A factor for the whole picture."""
    values = np.zeros(len(_SPREAD))
    values[0] = np.log(scale)
    return DepthField(values, 0.0)


def fit_field(points: KnownDepths, size: Size, before: DepthField) -> DepthField:
    """The field that carries the frame's depths to those of the points, robustly.

    Args:
        points: What is known.
        size: (height, width) of the picture.
        before: Of the frame before. Its scale is expected; without points it is the answer, but for a part that fades.
    """
    if len(points.own) < LEAST_POINTS:
        return DepthField(before.values * _KEPT, before.middle)
    expected = plain_field(before.scale).values
    middle = float(np.median(points.own))
    terms = _terms(points.places, size, points.own - middle)
    wanted = points.found - points.own
    worth = min(1.0, _WORTH / len(wanted))
    values = plain_field(float(np.exp(np.median(wanted)))).values
    prior = np.diag(1 / _SPREAD**2)
    for _ in range(_ROUNDS):
        off = wanted - terms @ values
        noise = max(1.4826 * float(np.median(np.abs(off))), _LEAST_NOISE)
        variance = noise**2 + (_TRUST * points.doubt) ** 2
        share = worth / (1 + off**2 / (4 * variance)) / variance
        square = terms.T @ (terms * share[:, None]) + prior
        values = np.asarray(np.linalg.solve(square, terms.T @ (share * wanted) + prior @ expected), np.float64)
    return DepthField(np.clip(values, -_MOST, _MOST), middle)


def _terms(places: F64, size: Size, own: F64) -> F64:
    """What the values are multiplied with (n, 40) at some pixels."""
    u, v = places[:, 0] / size[1] * 2 - 1, places[:, 1] / size[0] * 2 - 1
    local = _bumps(v)[:, :, None] * _bumps(u)[:, None, :]
    return np.concatenate([np.stack([np.ones_like(u), u, v, own], 1), local.reshape(len(u), -1)], 1)


def _bumps(across: F64) -> F64:
    """β (n, 6) at places from -1 to 1."""
    return np.asarray(np.exp(-0.5 * ((across[:, None] - _GRID) / _WIDTH) ** 2), np.float64)

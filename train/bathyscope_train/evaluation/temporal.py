"""Do predictions of neighbouring frames agree once one is carried into the other? Needs true poses.

Depth of frame ``a`` is lifted to 3-D, seen from camera ``b``, and compared with the depth predicted there. Two
published errors do this, which differ in the pixels that they take:

* TAE and TAS of EndoDAV: pixels with true depth in both frames;
* TAE of Video Depth Anything: every pixel with predicted depth.

How a point finds its pixel is a :class:`Warping`; the default is what the conventions say, and the published
evaluators have their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size

F32 = NDArray[np.float32]
_WITHIN = 1.25
_IN_FRONT = 1e-6


@dataclass(frozen=True, slots=True)
class Warping:
    """How points of one frame land in the pixels of another."""

    centre: float = 0.5
    """Where a pixel's centre lies: 0.5 past its corner, or 0.0 for whole numbers."""
    rounded: bool = False
    """Round the landing point, half to even, without removing ``centre``; otherwise the pixel it falls into."""
    nearest_wins: bool = True
    """Of points in one pixel the nearest counts; otherwise the last in scan order."""


ENDODAV_WARPING = Warping(centre=0.5, rounded=True, nearest_wins=False)
VDA_WARPING = Warping(centre=0.0, rounded=True, nearest_wins=False)


@dataclass(frozen=True, slots=True)
class View:
    """One frame of a temporal error."""

    depth: NDArray[np.floating]
    """(h, w) aligned and clipped prediction."""
    mask: NDArray[np.bool_]
    """(h, w) pixels that count."""
    camera_from_world: F64
    """(4, 4)"""
    intrinsics: F64
    """(3, 3) at the size of ``depth``."""


@dataclass(frozen=True, slots=True)
class TemporalError:
    """Of one pair of frames, mean of both directions; NaN where nothing of one frame lands in the other."""

    tae: float
    """Mean relative difference, in per cent."""
    tas: float
    """Share of pixels within a factor of 1.25."""


def fixed_intrinsics(size: Size) -> F64:
    """The camera that the AF-SfMLearner family gives to all of SCARED: fx = 0.82 W, fy = 1.02 H, central."""
    h, w = size
    return np.array([[0.82 * w, 0.0, 0.5 * w], [0.0, 1.02 * h, 0.5 * h], [0.0, 0.0, 1.0]])


def temporal_error(a: View, b: View, warping: Warping = Warping()) -> TemporalError:
    """Carry each frame into the other and compare.

    Args:
        a: A frame.
        b: Its neighbour, of the same size.
        warping: How points find pixels.
    """
    forward, backward = _one_way(a, b, warping), _one_way(b, a, warping)
    return TemporalError(tae=100.0 * (forward[0] + backward[0]) / 2, tas=(forward[1] + backward[1]) / 2)


def warp(source: View, target: View, warping: Warping = Warping()) -> F64:
    """Depth of ``source`` as camera ``target`` sees it: (h, w), 0 where no point lands."""
    h, w = source.depth.shape
    rows, columns = np.nonzero(source.mask)
    d = np.asarray(source.depth[rows, columns], np.float64)
    lifted = np.stack([(columns + warping.centre) * d, (rows + warping.centre) * d, d])
    motion = target.camera_from_world @ np.linalg.inv(source.camera_from_world)
    turn = target.intrinsics @ motion[:3, :3] @ np.linalg.inv(source.intrinsics)
    x, y, z = turn @ lifted + (target.intrinsics @ motion[:3, 3])[:, None]
    ahead = z > _IN_FRONT
    z = z[ahead]
    u, v = x[ahead] / z, y[ahead] / z
    if warping.rounded:
        u, v = np.rint(u), np.rint(v)
    else:
        u, v = np.floor(u + 0.5 - warping.centre), np.floor(v + 0.5 - warping.centre)
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    place = v[inside].astype(np.intp) * w + u[inside].astype(np.intp)
    return _written(place, z[inside], (h, w), warping.nearest_wins)


def _written(place: NDArray[np.intp], z: F64, size: Size, nearest_wins: bool) -> F64:
    if nearest_wins:
        nearest = np.full(size[0] * size[1], np.inf)
        np.minimum.at(nearest, place, z)
        return np.where(np.isfinite(nearest), nearest, 0.0).reshape(size)
    last = np.zeros(size[0] * size[1])
    last[place] = z
    return last.reshape(size)


def _one_way(source: View, target: View, warping: Warping) -> tuple[float, float]:
    landed = warp(source, target, warping)
    keep = target.mask & (landed > _IN_FRONT)
    if not keep.any():
        return float("nan"), float("nan")
    expected, observed = landed[keep], np.asarray(target.depth, np.float64)[keep]
    relative = np.abs(observed - expected) / observed
    ratio = np.maximum(observed / expected, expected / observed)
    return float(relative.mean()), float((ratio < _WITHIN).mean())

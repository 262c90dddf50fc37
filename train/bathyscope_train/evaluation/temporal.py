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
from bathyscope_train.evaluation.warp_kernel import disagreement, scatter

F32 = NDArray[np.float32]
_WITHIN = 1.25


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
    motion = target.camera_from_world @ np.linalg.inv(source.camera_from_world)
    turn = target.intrinsics @ motion[:3, :3] @ np.linalg.inv(source.intrinsics)
    landed = np.zeros(source.depth.shape)
    scatter(
        np.ascontiguousarray(source.depth, np.float64),
        np.ascontiguousarray(source.mask),
        np.ascontiguousarray(turn, np.float64),
        np.ascontiguousarray(target.intrinsics @ motion[:3, 3], np.float64),
        warping.centre,
        warping.rounded,
        warping.nearest_wins,
        landed,
    )
    return landed


def _one_way(source: View, target: View, warping: Warping) -> tuple[float, float]:
    landed = warp(source, target, warping)
    depth, mask = np.ascontiguousarray(target.depth, np.float64), np.ascontiguousarray(target.mask)
    total, agree, count = disagreement(landed, depth, mask, _WITHIN)
    return (total / count, agree / count) if count else (float("nan"), float("nan"))

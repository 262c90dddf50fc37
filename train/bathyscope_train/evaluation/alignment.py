"""Alignment of what is right up to scale with what has one: depth by medians, trajectories by Sim(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Similarity
from bathyscope.errors import GeometryError

_STANDS_STILL = 1e-9
"""A trajectory whose spread is below this share of its distance from the origin does not move."""


def median_scale(truth: Sequence[NDArray[np.floating]], predicted: Sequence[NDArray[np.floating]]) -> float:
    """The factor median(truth) / median(predicted) over all pixels of all frames of a clip together.

    Raises:
        GeometryError: If there is no pixel, or the median prediction is not positive.
    """
    g = np.concatenate([np.ravel(values) for values in truth]) if len(truth) else np.zeros(0)
    p = np.concatenate([np.ravel(values) for values in predicted]) if len(predicted) else np.zeros(0)
    if g.size == 0 or p.size == 0:
        raise GeometryError("median scaling needs at least one pixel with true and predicted depth, got none")
    ratio = float(np.median(g)) / float(np.median(p)) if np.median(p) > 0 else float("nan")
    if not (np.isfinite(ratio) and ratio > 0):
        raise GeometryError(f"median scaling needs positive depths, got medians {np.median(g)} and {np.median(p)}")
    return ratio


def stands_still(positions: F64) -> bool:
    """Whether positions (n, 3) are one point, up to rounding."""
    centred = positions - positions.mean(axis=0)
    return bool(np.abs(centred).max() <= _STANDS_STILL * max(1.0, float(np.abs(positions).max())))


def align_positions(source: F64, target: F64) -> Similarity:
    r"""The similarity that brings ``source`` closest to ``target``.

    Minimises :math:`\sum_i \| y_i - (s R x_i + t) \|^2` over scale, rotation and translation (Umeyama, PAMI 1991).

    Args:
        source: Positions (n, 3).
        target: Positions (n, 3) of the same cameras.

    Raises:
        GeometryError: If the shapes differ, there are fewer than three positions, or ``source`` is one point.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise GeometryError(f"alignment needs two (n, 3) arrays with n >= 3, got {source.shape} and {target.shape}")
    if stands_still(source):
        raise GeometryError("alignment needs positions that differ; these are all the same point, so scale is unknown")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    x, y = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(y.T @ x / len(x))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / np.mean((x**2).sum(axis=1)))
    if scale <= 0:
        raise GeometryError("the best scale between these positions is not positive: the target does not move")
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))

"""How sure a mean is: 95 % intervals that respect that frames of one video are alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64

DRAWS = 10_000
_SEED = 20260101
Averaging = Literal["sequences", "frames"]


def finite_mean(values: NDArray[np.floating]) -> float:
    """Mean of the values that are not NaN; NaN if there is none."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def grand_mean(frames: Sequence[F64], averaging: Averaging) -> float:
    """Mean of per-frame values (t,) of several sequences; NaN values are left out, and NaN if none is left.

    Args:
        frames: Values of each sequence.
        averaging: ``sequences`` for the plain mean of their means, ``frames`` for all frames in one pool.
    """
    if averaging == "frames":
        return finite_mean(np.concatenate([np.asarray(f, np.float64) for f in frames]) if frames else np.zeros(0))
    return finite_mean(np.array([finite_mean(np.asarray(f, np.float64)) for f in frames]))


def bootstrap_interval(frames: Sequence[F64], averaging: Averaging, draws: int = DRAWS) -> tuple[float, float] | None:
    """95 % percentile interval of :func:`grand_mean` over sequences drawn with replacement.

    Whole sequences are drawn, because the frames of one are not independent. The draws are the same in every call.

    Returns:
        Low and high, or ``None`` for fewer than two sequences with a value: one video says nothing about others.
    """
    sums = np.array([np.nansum(f) for f in frames])
    counts = np.array([np.count_nonzero(~np.isnan(f)) for f in frames], np.float64)
    sums, counts = sums[counts > 0], counts[counts > 0]
    n = len(sums)
    if n < 2:
        return None
    chosen = np.random.default_rng(_SEED).integers(0, n, (draws, n))
    if averaging == "frames":
        means = sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    else:
        means = (sums / counts)[chosen].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def student_interval(values: NDArray[np.floating]) -> tuple[float, float] | None:
    """95 % interval of a mean as if values (n,) were independent, as published evaluators print it.

    NaN values are not left out: one makes the interval NaN.

    Returns:
        Low and high, or ``None`` for fewer than two values.
    """
    from scipy import stats

    x = np.asarray(values, np.float64)
    if x.size < 2:
        return None
    half = float(stats.t.ppf(0.975, x.size - 1)) * float(x.std(ddof=1)) / np.sqrt(x.size)
    return float(x.mean() - half), float(x.mean() + half)

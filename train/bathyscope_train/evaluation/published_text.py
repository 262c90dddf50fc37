"""The lines that public evaluators print, for those who compare logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bathyscope_train.evaluation.intervals import student_interval


def scaling_line(ratios: Sequence[float]) -> str:
    """`` Scaling ratios | med: 183.462 | std: 0.552``; the spread is that of ratios over their median."""
    r = np.asarray(ratios, np.float64)
    middle = float(np.median(r))
    return f" Scaling ratios | med: {middle:0.3f} | std: {float(np.std(r / middle)):0.3f}"


def shift_line(medians: Sequence[tuple[float, float, float, float]]) -> str:
    """`` Aligning shift and scale | t_gt: ...`` of (t_gt, s_gt, t_pred, s_pred) of each sequence, their means."""
    names = ("t_gt", "s_gt", "t_pred", "s_pred")
    means = np.asarray(medians, np.float64).mean(axis=0)
    values = " | ".join(f"{name}: {value:0.3f}" for name, value in zip(names, means, strict=True))
    return f" Aligning shift and scale | {values}"


def mean_line(columns: Sequence[NDArray[np.floating]]) -> str:
    """``mean:&       0.120      & ...`` of the values (n,) of each column; one NaN makes a column ``nan``."""
    return "mean:" + "".join(f"&{float(np.mean(column)):12.3f}      " for column in columns) + "\\\\"


def interval_line(columns: Sequence[NDArray[np.floating]]) -> str:
    """``cls: & [ 0.114,  0.125] & ...``: Student's t over the values (n,) of each column."""
    intervals = [student_interval(column) or (np.nan, np.nan) for column in columns]
    return "cls: " + " ".join(f"& [{low: 6.3f}, {high: 6.3f}]" for low, high in intervals) + " \\\\"

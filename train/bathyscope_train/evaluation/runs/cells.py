"""Numbers as they stand in a table: digits, arrows, and which is the best."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bathyscope_train.evaluation.runs.summary import Line

HIGHER_IS_BETTER = frozenset({"delta1", "delta2", "delta3", "tas"})
TITLES = {
    "abs_rel": "Abs Rel",
    "sq_rel": "Sq Rel",
    "rmse": "RMSE",
    "rmse_log": "RMSE log",
    "delta1": "δ1",
    "delta2": "δ2",
    "delta3": "δ3",
    "tae": "TAE %",
    "tas": "TAS",
    "flicker": "flicker %",
    "true_flicker": "flicker of truth %",
    "scale_drift": "scale drift",
}
NOTHING = "–"


def number(value: float | None) -> str:
    """Three decimals, as the field prints them; more for small numbers, fewer for large ones."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if value != 0 and abs(value) < 0.01:
        return f"{value:.2g}"
    return f"{value:.3f}" if abs(value) < 1000 else f"{value:.0f}"


def arrow(name: str) -> str:
    """Which way is better."""
    return "↑" if name in HIGHER_IS_BETTER else "↓"


def title(name: str) -> str:
    """Head of a column."""
    return TITLES[name] if name == "true_flicker" else f"{TITLES[name]} {arrow(name)}"


def best(lines: Sequence[Line], name: str) -> frozenset[str]:
    """Systems whose number, as printed, is the best of its column.

    Only systems with numbers for every sequence can be best, and only where there are at least two to compare.
    """
    printed = {
        line.system: float(number(line.values[name]))
        for line in lines
        if line.complete and math.isfinite(line.values.get(name, math.nan))
    }
    if len(printed) < 2 or name == "true_flicker":
        return frozenset()
    winner = max(printed.values()) if name in HIGHER_IS_BETTER else min(printed.values())
    return frozenset(system for system, value in printed.items() if value == winner)

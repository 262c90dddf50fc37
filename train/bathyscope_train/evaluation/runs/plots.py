"""Plots of an evaluation, as PNG: drawn without a display, colours kept from system to system."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bathyscope_train.evaluation.binned import BinnedErrors
from bathyscope_train.evaluation.runs.cells import NOTHING, number
from bathyscope_train.evaluation.runs.folder import safe
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.summary import Line, SequenceNumbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """An empty figure that needs no display, and its axes row by row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawn)
    return drawn, list(np.ravel(drawn.subplots(rows, columns, squeeze=False)))


def draw_plots(folder: Path, lines: Sequence[Line]) -> list[Path]:
    """Error against depth and per sequence for each data set, and against frame number for each sequence.

    Args:
        folder: Where the PNG go; made if missing.
        lines: Rows of the summary; those of all frames are drawn.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for dataset in dict.fromkeys(line.dataset for line in lines):
        mine = [line for line in lines if line.dataset == dataset and line.group == ALL_FRAMES and line.values]
        if not mine:
            continue
        files.append(_against_depth(folder / f"{safe(dataset)}_depth.png", dataset, mine))
        files.append(_per_sequence(folder / f"{safe(dataset)}_sequences.png", dataset, mine))
        for sequence in dict.fromkeys(part.name for line in mine for part in line.parts):
            path = folder / f"{safe(dataset)}_{safe(sequence)}_frames.png"
            files.append(_against_frames(path, f"{dataset}/{sequence}", mine, sequence))
    return files


def _against_depth(path: Path, dataset: str, lines: Sequence[Line]) -> Path:
    drawn, (left, right) = figure(9, 3.4, columns=2)
    for line in lines:
        binned = BinnedErrors.empty()
        for part in line.parts:
            stored = part.record.groups[ALL_FRAMES].by_depth
            if stored is not None:
                binned += BinnedErrors.from_dict(stored)
        depth, absolute, signed = binned.curve()
        left.plot(depth, absolute, marker=".", label=line.system)
        right.plot(depth, signed, marker=".", label=line.system)
    unit = lines[0].parts[0].unit
    for axes, what in ((left, "mean |p - g| / g"), (right, "mean (p - g) / g")):
        axes.set(xscale="log", xlabel=f"true depth ({unit})", ylabel=what, title=dataset)
        axes.grid(alpha=0.3)
    right.axhline(0, color="black", linewidth=0.8)
    left.legend(fontsize="small")
    return _saved(drawn, path)


def _per_sequence(path: Path, dataset: str, lines: Sequence[Line]) -> Path:
    names = list(dict.fromkeys(part.name for line in lines for part in line.parts))
    drawn, (axes,) = figure(max(4.0, 1.2 + 0.35 * len(names) * (len(lines) + 1)), 3.4)
    width = 0.8 / len(lines)
    for count, line in enumerate(lines):
        means = {part.name: _mean(part) for part in line.parts}
        places = np.arange(len(names)) + (count - (len(lines) - 1) / 2) * width
        axes.bar(places, [means.get(name, np.nan) for name in names], width, label=line.system)
    axes.set(ylabel="Abs Rel", title=f"{dataset}, mean over the frames of each sequence")
    crowded = len(names) > 3
    axes.set_xticks(np.arange(len(names)), names, rotation=45 if crowded else 0, ha="right" if crowded else "center")
    axes.legend(fontsize="small")
    return _saved(drawn, path)


def _against_frames(path: Path, name: str, lines: Sequence[Line], sequence: str) -> Path:
    drawn, (axes,) = figure(8, 3.2)
    for line in lines:
        for part in line.parts:
            if part.name == sequence:
                label = f"{line.system} ({number(_mean(part))})" if number(_mean(part)) != NOTHING else line.system
                axes.plot([row.index for row in part.rows], part.column("abs_rel"), linewidth=1, label=label)
    axes.set(xlabel="frame", ylabel="Abs Rel", title=name, ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return _saved(drawn, path)


def _mean(part: SequenceNumbers) -> float:
    values = part.column("abs_rel")
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else float("nan")


def _saved(drawn: Figure, path: Path) -> Path:
    drawn.savefig(path, dpi=120)
    return path

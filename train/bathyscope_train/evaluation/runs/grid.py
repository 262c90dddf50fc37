"""A picture that compares systems on one frame of each sequence: image, truth, aligned depths, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bathyscope_train.evaluation.example import Example
from bathyscope_train.evaluation.runs.folder import RunFolder
from bathyscope_train.evaluation.runs.plots import figure
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.summary import Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ROWS = 6
"""Sequences in one picture; of more, those that lie evenly among them."""
WORST = 0.5
"""Relative error at which the colours of an error map end."""


def draw_grid(path: Path, folder: RunFolder, dataset: str, lines: Sequence[Line]) -> Path | None:
    """One row for each sequence and below it the errors; columns are image, truth, systems.

    Args:
        path: The PNG.
        folder: Where the examples lie.
        dataset: Name of the data set.
        lines: Rows of its summary.

    Returns:
        The file, or ``None`` if there is nothing to show.
    """
    systems = [line for line in lines if line.group == ALL_FRAMES and line.values]
    examples = {line.system: _examples(folder, line) for line in systems}
    names = list(dict.fromkeys(name for found in examples.values() for name in found))
    if not names:
        return None
    evenly = np.linspace(0, len(names) - 1, min(MOST_ROWS, len(names))).round().astype(int)
    picked = [names[number] for number in evenly]
    columns = 2 + len(systems)
    drawn, axes = figure(2.2 * columns, 3.6 * len(picked), 2 * len(picked), columns)
    for axis in axes:
        axis.set_axis_off()
    for row, name in enumerate(picked):
        shown = {system: found[name] for system, found in examples.items() if name in found}
        top = axes[2 * row * columns : (2 * row + 1) * columns]
        below = axes[(2 * row + 1) * columns : (2 * row + 2) * columns]
        _row(top, below, name if name == dataset else f"{dataset}/{name}", shown, [line.system for line in systems])
    drawn.savefig(path, dpi=100)
    return path


def _row(top: Sequence[Axes], below: Sequence[Axes], name: str, shown: dict[str, Example], systems: list[str]) -> None:
    first = next(iter(shown.values()))
    known = first.true > 0
    low, high = np.percentile(first.true[known], [2, 98]) if known.any() else (0.0, 1.0)
    top[0].imshow(first.image)
    top[0].set_title(f"{name}\nframe {first.index}", fontsize="small")
    top[1].imshow(np.where(known, first.true, np.nan), vmin=low, vmax=high, cmap="magma_r")
    top[1].set_title("true depth", fontsize="small")
    below[1].text(
        0.5, 0.5, f"this row: |p - g| / g,\n0 (dark) to {WORST:g}", ha="center", va="center", fontsize="small"
    )
    for column, system in enumerate(systems, 2):
        if system not in shown:
            continue
        example = shown[system]
        depth = np.where(example.depth > 0, example.depth, np.nan)
        both = (example.true > 0) & (example.depth > 0)
        error = np.abs(example.depth - example.true) / np.where(both, example.true, 1)
        top[column].imshow(depth, vmin=low, vmax=high, cmap="magma_r")
        top[column].set_title(system, fontsize="small")
        below[column].imshow(np.where(both, error, np.nan), vmin=0, vmax=WORST, cmap="viridis")


def _examples(folder: RunFolder, line: Line) -> dict[str, Example]:
    found = {}
    for part in line.parts:
        path = folder.job(line.system, line.dataset, part.name) / "example.npz"
        if path.is_file():
            found[part.name] = Example.load(path)
    return found

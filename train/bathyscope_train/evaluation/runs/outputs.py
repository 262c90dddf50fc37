"""Writes everything that an evaluation gives to people: tables, plots, and the numbers as files."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from bathyscope_train.evaluation.frame_rows import FrameRow, write_rows
from bathyscope_train.evaluation.intervals import finite_mean
from bathyscope_train.evaluation.protocols import SEVEN_COLUMNS, Quirk
from bathyscope_train.evaluation.runs.folder import safe, write_json, write_text
from bathyscope_train.evaluation.runs.grid import draw_grid
from bathyscope_train.evaluation.runs.latex import latex
from bathyscope_train.evaluation.runs.layouts import Layout
from bathyscope_train.evaluation.runs.markdown import markdown
from bathyscope_train.evaluation.runs.plots import draw_plots
from bathyscope_train.evaluation.runs.published import published_lines
from bathyscope_train.evaluation.runs.run import RunOutcome
from bathyscope_train.evaluation.runs.statements import checkpoint, data_statement, system_statement
from bathyscope_train.evaluation.runs.summary import TEMPORAL_COLUMNS, Line, summarise

_COLUMNS = (*SEVEN_COLUMNS, *TEMPORAL_COLUMNS, "coverage", "truth_share")


def write_outputs(outcome: RunOutcome, layout: Layout, *, plots: bool = True) -> list[Line]:
    """Write all files into the folder of the evaluation.

    Args:
        outcome: What was measured.
        layout: Shape of the tables.
        plots: Whether to draw.

    Returns:
        The rows of the summary.
    """
    folder, lines = outcome.folder, summarise(outcome)
    write_rows(folder.path / "per_frame.csv", _frames(lines))
    _write_sequences(folder.path / "per_sequence.csv", lines)
    write_text(folder.path / "summary.md", markdown(outcome, lines, layout))
    write_text(folder.path / "summary.tex", latex(outcome, lines, layout))
    write_json(folder.path / "summary.json", _json(outcome, lines))
    if Quirk.STUDENT_T in outcome.protocol.quirks:
        write_text(folder.path / "published.txt", published_lines(lines, outcome.protocol))
    if plots:
        draw_plots(folder.path / "plots", lines)
        for dataset in outcome.data:
            mine = [line for line in lines if line.dataset == dataset]
            draw_grid(folder.path / "plots" / f"{safe(dataset)}_grid.png", folder, dataset, mine)
    return lines


def _frames(lines: Sequence[Line]) -> Iterator[tuple[dict[str, str], FrameRow]]:
    for line in lines:
        for part in line.parts:
            leading = {"system": line.system, "dataset": line.dataset, "sequence": part.name, "group": line.group}
            yield from ((leading, row) for row in part.rows)


def _write_sequences(path: Path, lines: Sequence[Line]) -> None:
    """Plain means over the frames of each sequence, and what was fitted."""
    head = ["system", "dataset", "sequence", "group", "outcome", "frames", "measured", "unit", "scale", "shift"]
    beside = path.with_name(f".{path.name}.part")
    with beside.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*head, *_COLUMNS, "checkpoint"])
        for line in lines:
            for part in line.parts:
                group = part.record.groups[line.group]
                fitted = ["" if value is None else repr(value) for value in (group.scale, group.shift)]
                means = [finite_mean(part.column(name)) for name in _COLUMNS]
                cells = ["" if math.isnan(value) else repr(value) for value in means]
                about = [group.outcome, group.frames, group.measured, group.unit, *fitted]
                names = [line.system, line.dataset, part.name, line.group]
                writer.writerow([*names, *about, *cells, checkpoint(line.info)])
    beside.replace(path)


def _json(outcome: RunOutcome, lines: Sequence[Line]) -> dict[str, object]:
    return {
        "protocol": {
            "name": outcome.protocol.name,
            "hash": outcome.protocol.hash,
            "words": list(outcome.protocol.words()),
        },
        "data": {
            label: data_statement(label, chosen, [line for line in lines if line.dataset == label])
            for label, chosen in outcome.data.items()
        },
        "rows": [_row(line) for line in lines],
        "problems": outcome.problems,
    }


def _row(line: Line) -> dict[str, object]:
    return {
        "system": line.system,
        "dataset": line.dataset,
        "group": line.group,
        "missing": line.missing,
        "complete": line.complete,
        "statement": system_statement(line),
        "checkpoint": None if line.info is None else line.info.weights_sha256,
        "sequences": line.sequences,
        "measured_sequences": line.measured_sequences,
        "frames": line.frames,
        "measured_frames": line.measured_frames,
        "left_out": line.left_out,
        "coverage": _known(line.coverage),
        "truth_share": _known(line.truth_share),
        "values": {name: _known(value) for name, value in line.values.items()},
        "intervals_95": {name: list(interval) for name, interval in line.intervals.items()},
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None

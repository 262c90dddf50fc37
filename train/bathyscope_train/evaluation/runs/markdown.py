"""The summary of an evaluation in Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.runs.cells import NOTHING, best, number, title
from bathyscope_train.evaluation.runs.layouts import CELLS, HEADS, Layout
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.run import RunOutcome
from bathyscope_train.evaluation.runs.statements import (
    checkpoint,
    data_statement,
    incomplete_statement,
    interval_statement,
    system_statements,
)
from bathyscope_train.evaluation.runs.summary import TEMPORAL_COLUMNS, Line

_INCOMPLETE = "\\*"
_POSES = (
    ("ATE", "ate_rmse"),
    ("ATE standing still", "ate_standing_still"),
    ("RPE translation", "rpe_translation"),
    ("RPE rotation (deg)", "rpe_rotation_deg"),
    ("5-frame ATE", "snippet_ate_mean"),
)


def markdown(outcome: RunOutcome, lines: Sequence[Line], layout: Layout) -> str:
    """Tables for every data set, and beneath them how the numbers came about."""
    protocol = outcome.protocol
    parts = [f"# Evaluation, protocol `{protocol.name}` ({protocol.hash})"]
    for label, chosen in outcome.data.items():
        for group in dict.fromkeys(line.group for line in lines if line.dataset == label):
            mine = [line for line in lines if (line.dataset, line.group) == (label, group)]
            parts.append(f"## {label}" if group == ALL_FRAMES else f"## {label}, {group} only")
            parts.append(error_table(mine, protocol, layout))
            parts.append(data_statement(label, chosen, mine))
            parts += [text for line in mine if (text := incomplete_statement(line)) is not None]
            parts += [table for table in (_intervals(mine, protocol), _temporal(mine), _cameras(mine)) if table]
    parts.append("## How these numbers came about")
    parts.append("\n".join(f"- {text}" for text in (*protocol.words(), interval_statement(protocol))))
    parts.append("\n".join(f"- {text}" for text in system_statements(lines)))
    if outcome.problems:
        parts.append(f"## What is missing ({len(outcome.problems)})")
        parts.append("\n".join(f"- {problem}" for problem in outcome.problems))
    return "\n\n".join(parts) + "\n"


def error_table(lines: Sequence[Line], protocol: Protocol, layout: Layout) -> str:
    """Errors in the order of the paper, best in bold; then coverage and the checkpoint."""
    columns = protocol.columns
    winners = {name: best(lines, name) for name in columns}
    rows = []
    for line in lines:
        cells = list(CELLS[layout](line.system))
        if line.missing is not None:
            rows.append(
                [*cells, line.missing.split(":")[0], *[""] * (len(columns) - 1), NOTHING, checkpoint(line.info)]
            )
            continue
        mark = "" if line.complete else _INCOMPLETE
        for name in columns:
            text = number(line.values[name]) + mark
            cells.append(f"**{text}**" if line.system in winners[name] else text)
        rows.append([*cells, f"{line.coverage:.1%}", checkpoint(line.info)])
    return table([*HEADS[layout], *(title(name) for name in columns), "coverage", "checkpoint"], rows)


def _intervals(lines: Sequence[Line], protocol: Protocol) -> str:
    rows = [[line.system, *(_interval(line, name) for name in protocol.columns)] for line in lines if line.intervals]
    return table(["95 % interval", *(title(name) for name in protocol.columns)], rows) if rows else ""


def _interval(line: Line, name: str) -> str:
    found = line.intervals.get(name)
    return NOTHING if found is None else f"{number(found[0])} to {number(found[1])}"


def _temporal(lines: Sequence[Line]) -> str:
    names = [
        name
        for name in (*TEMPORAL_COLUMNS, "scale_drift")
        if any(number(line.values.get(name)) != NOTHING for line in lines)
    ]
    rows = [[line.system, *(number(line.values.get(name)) for name in names)] for line in lines if line.values]
    return table(["over time", *(title(name) for name in names)], rows) if names else ""


def _cameras(lines: Sequence[Line]) -> str:
    rows = []
    for line in lines:
        for part in line.parts:
            poses, focal = part.record.poses, part.record.focal
            if line.group != ALL_FRAMES or (poses is None and focal is None):
                continue
            cells = [NOTHING if poses is None else number(getattr(poses, field)) for _, field in _POSES]
            ratio = NOTHING if focal is None else f"{focal.fx_ratio:.2f}, {focal.fy_ratio:.2f}"
            rows.append([line.system, part.name, NOTHING if poses is None else poses.unit, *cells, ratio])
    head = ["cameras", "sequence", "unit", *(head for head, _ in _POSES), "focal / true (x, y)"]
    return table(head, rows) if rows else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; pipes in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)

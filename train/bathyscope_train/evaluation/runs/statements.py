"""The sentences without which no number of an evaluation appears."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bathyscope_train.evaluation.protocols import Protocol, Quirk
from bathyscope_train.evaluation.runs.cells import NOTHING
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.summary import Line
from bathyscope_train.evaluation.sequences import EvaluationSet
from bathyscope_train.systems.system import SystemInfo


def data_statement(label: str, chosen: EvaluationSet, lines: Sequence[Line]) -> str:
    """Split, hash, frames, caps and coverage of the truth of one data set.

    Args:
        label: What tables call it.
        chosen: The data set.
        lines: The rows of its table.
    """
    group = lines[0].group if lines else ALL_FRAMES
    known = next((line for line in lines if line.parts), None)
    which = "" if group == ALL_FRAMES else f", {group} only"
    text = (
        f"{label}{which}: {chosen.split}; split hash {chosen.split_hash}; "
        f"{counted(len(chosen.sequences), 'sequence')}, {counted(chosen.frame_count, 'frame')}"
    )
    if known is None:
        return f"{text}."
    part = known.parts[0].record.groups[group]
    units = sorted({p.unit for p in known.parts})
    high = "none" if part.caps[1] is None else f"{part.caps[1]:g}"
    caps = sorted({p.record.groups[group].caps for p in known.parts}, key=str)
    many = f" ({len(caps)} different caps)" if len(caps) > 1 else ""
    text += f"; caps {part.caps[0]:g} to {high} {part.unit}{many}"
    text += f"; true depth at {_percent(known.truth_share)} of the pixels"
    text += f"; {known.frames} frames looked at" if known.frames != chosen.frame_count else ""
    if len(units) > 1:
        text += f"; mixed units ({', '.join(units)}), so Sq Rel and RMSE have no mean"
    notes = dict.fromkeys(note for sequence in chosen.sequences for note in sequence.notes)
    text += "".join(f"; {note}" for note in notes)
    if chosen.gaps:
        text += f"; {counted(len(chosen.gaps), 'gap')}, listed below"
    return f"{text}."


def _percent(share: float) -> str:
    """One decimal, and two digits of small shares."""
    return f"{share:.1%}" if share >= 0.01 else f"{100 * share:.2g}%"


def counted(number: int, what: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def system_statement(line: Line) -> str:
    """Checkpoint, licence and meaning of the values of one system."""
    if line.missing is not None and line.info is None:
        return f"{line.system}: {line.missing}."
    info = line.info
    assert info is not None
    details = ", ".join(f"{key} {value}" for key, value in info.details.items())
    licence = f"; licence {info.licence}" if info.licence else ""
    meaning = f"{info.scale} {info.quantity}"
    text = f"{line.system}: {info.name}; checkpoint {checkpoint(info)}{licence}; gives {meaning}"
    return f"{text} ({details})." if details else f"{text}."


def system_statements(lines: Sequence[Line]) -> list[str]:
    """One for each system, in the order of the table."""
    best: dict[str, Line] = {}
    for line in lines:
        if line.system not in best or best[line.system].info is None:
            best[line.system] = line
    return [system_statement(line) for line in best.values()]


def checkpoint(info: SystemInfo | None) -> str:
    """First 12 digits of the hash of the weights; ``none`` for a system that has no weights."""
    if info is None:
        return NOTHING
    return "none" if info.weights_sha256 is None else info.weights_sha256[:12]


def incomplete_statement(line: Line) -> str | None:
    """What a row leaves out; ``None`` if it leaves out nothing."""
    parts = []
    if line.missing is None and not line.complete:
        parts.append(f"{line.measured_sequences} of {line.sequences} sequences have numbers")
    if line.left_out:
        parts.append(f"of {counted(line.frames, 'frame')} without numbers: {line.left_out}")
    if np.isfinite(line.coverage) and line.coverage < 1:
        parts.append(f"predicts {line.coverage:.2%} of the pixels with truth")
    return f"{line.system}: {'; '.join(parts)}." if parts else None


def interval_statement(protocol: Protocol) -> str:
    """What the intervals are."""
    if Quirk.STUDENT_T in protocol.quirks:
        return "95 % intervals: Student's t over frames, as if they were independent."
    return "95 % intervals: 10,000 bootstrap draws of whole sequences; none for a single sequence."

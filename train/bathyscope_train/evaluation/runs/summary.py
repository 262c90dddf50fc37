"""From per-frame numbers to the numbers of a table, with all that must stand beside them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from bathyscope.camera import F64
from bathyscope_train.evaluation.frame_rows import FrameRow, Status, read_rows
from bathyscope_train.evaluation.intervals import bootstrap_interval, finite_mean, grand_mean, student_interval
from bathyscope_train.evaluation.measure import reasons
from bathyscope_train.evaluation.metrics import UNITS_OF_DEPTH
from bathyscope_train.evaluation.protocols import SEVEN_COLUMNS, Protocol, Quirk
from bathyscope_train.evaluation.runs.folder import RunFolder
from bathyscope_train.evaluation.runs.records import ALL_FRAMES, SequenceRecord
from bathyscope_train.evaluation.runs.run import RunOutcome, SystemOutcome
from bathyscope_train.systems.system import SystemInfo

TEMPORAL_COLUMNS = ("tae", "tas", "flicker", "true_flicker")
Interval = tuple[float, float]


@dataclass(frozen=True)
class SequenceNumbers:
    """One system on one sequence."""

    name: str
    rows: tuple[FrameRow, ...]
    unit: str
    record: SequenceRecord

    def column(self, name: str) -> F64:
        """One number of every frame, NaN where there is none."""
        return np.array([getattr(row, name) for row in self.rows], np.float64)

    @property
    def scale_drift(self) -> float:
        """Spread of the frames' own scales over their median; NaN unless each frame has its own."""
        scales = self.column("scale")
        scales = scales[~np.isnan(scales)]
        return float(np.std(scales / np.median(scales))) if scales.size else float("nan")


@dataclass(frozen=True)
class Line:
    """One row of a table: a system on a data set, or on a named choice of its frames."""

    system: str
    dataset: str
    group: str
    info: SystemInfo | None
    missing: str | None
    """Why there is no number; ``None`` if there is."""
    sequences: int = 0
    measured_sequences: int = 0
    frames: int = 0
    measured_frames: int = 0
    left_out: str = ""
    """Frames without numbers, by reason."""
    values: dict[str, float] = field(default_factory=dict)
    """Means by name; NaN where there is none, and where units cannot be mixed."""
    intervals: dict[str, Interval] = field(default_factory=dict)
    coverage: float = float("nan")
    truth_share: float = float("nan")
    parts: tuple[SequenceNumbers, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every sequence has numbers."""
        return self.missing is None and self.measured_sequences == self.sequences


def summarise(outcome: RunOutcome) -> list[Line]:
    """All rows, by data set, then by choice of frames, then by system in the order in which they were named."""
    lines = []
    for label, chosen in outcome.data.items():
        names = [sequence.name for sequence in chosen.sequences]
        groups = [ALL_FRAMES, *dict.fromkeys(name for sequence in chosen.sequences for name in sequence.groups)]
        for group in groups:
            lines += [_line(outcome, system, label, group, names) for system in outcome.systems]
    return lines


def _line(outcome: RunOutcome, system: SystemOutcome, dataset: str, group: str, names: list[str]) -> Line:
    records = system.records.get(dataset, {})
    info = next((record.info for record in records.values() if record.info is not None), None)
    if system.missing is not None:
        return Line(system.label, dataset, group, info, system.missing, sequences=len(names))
    wanted = [name for name in names if _has_group(records.get(name), group)]
    parts = [_numbers(outcome.folder, records[name], group) for name in wanted]
    measured = [part for part in parts if part.record.groups[group].measured]
    rows = [row for part in parts for row in part.rows]
    line = Line(
        system=system.label,
        dataset=dataset,
        group=group,
        info=info,
        missing=None if measured else "no sequence could be measured",
        sequences=len(names) if group == ALL_FRAMES else len(wanted),
        measured_sequences=len(measured),
        frames=len(rows),
        measured_frames=sum(row.status is Status.MEASURED for row in rows),
        left_out=reasons(rows),
        coverage=grand_mean([part.column("coverage") for part in parts], "frames"),
        truth_share=_truth_share(parts),
        parts=tuple(parts),
    )
    if measured:
        _fill(line, measured, outcome.protocol)
    return line


def _has_group(record: SequenceRecord | None, group: str) -> bool:
    return record is not None and group in record.groups


def _numbers(folder: RunFolder, record: SequenceRecord, group: str) -> SequenceNumbers:
    suffix = "" if group == ALL_FRAMES else f".{group}"
    path = folder.job(record.system, record.dataset, record.sequence) / f"rows{suffix}.csv"
    return SequenceNumbers(record.sequence, tuple(row for _, row in read_rows(path)), record.groups[group].unit, record)


def _truth_share(parts: Iterable[SequenceNumbers]) -> float:
    shares = np.concatenate([part.column("truth_share") for part in parts] or [np.zeros(0)])
    return finite_mean(shares[shares > 0])


def _fill(line: Line, measured: list[SequenceNumbers], protocol: Protocol) -> None:
    same_unit = len({part.unit for part in measured}) == 1
    for name in (*SEVEN_COLUMNS, *TEMPORAL_COLUMNS):
        if name in UNITS_OF_DEPTH and not same_unit:
            line.values[name] = float("nan")
            continue
        columns = [part.column(name) for part in measured]
        line.values[name] = _mean(columns, name, protocol)
        interval = _interval(columns, protocol)
        if interval is not None and np.isfinite(line.values[name]):
            line.intervals[name] = interval
    if protocol.per == "frame":
        line.values["scale_drift"] = finite_mean(np.array([part.scale_drift for part in measured]))


def _mean(columns: list[F64], name: str, protocol: Protocol) -> float:
    if name in ("tae", "tas") and Quirk.UNGUARDED in protocol.quirks:
        # The last frame of a sequence begins no pair; every other NaN is one without truth, and poisons the mean.
        return float(np.concatenate([column[:-1] for column in columns]).mean())
    return grand_mean(columns, protocol.averaging)


def _interval(columns: list[F64], protocol: Protocol) -> Interval | None:
    if Quirk.STUDENT_T not in protocol.quirks:
        return bootstrap_interval(columns, protocol.averaging)
    pooled = np.concatenate(columns)
    return student_interval(pooled[~np.isnan(pooled)])

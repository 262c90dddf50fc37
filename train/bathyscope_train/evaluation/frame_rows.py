"""What was measured on one frame, and its line in a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from bathyscope.errors import ResultError

NAN = float("nan")


class Status(StrEnum):
    """Whether a frame has numbers, and why not."""

    MEASURED = "measured"
    NO_TRUTH = "no truth"
    """No pixel with true depth inside the caps."""
    NO_PREDICTION = "no prediction"
    """No prediction where there is truth."""
    UNREADABLE = "truth unreadable"
    NOT_ALIGNED = "not aligned"


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One frame; NaN where there was nothing to measure."""

    index: int
    frame: str
    status: Status
    truth_share: float = NAN
    """Share of all pixels that have true depth inside the caps."""
    pixels: int = 0
    """Pixels measured."""
    coverage: float = NAN
    """Share of the pixels with truth that have a prediction."""
    scale: float = NAN
    shift: float = NAN
    abs_rel: float = NAN
    sq_rel: float = NAN
    rmse: float = NAN
    rmse_log: float = NAN
    delta1: float = NAN
    delta2: float = NAN
    delta3: float = NAN
    tae: float = NAN
    """Per cent, of this frame and the next."""
    tas: float = NAN
    flicker: float = NAN
    """Per cent, of this frame, the one before and the one after."""
    true_flicker: float = NAN
    """The same of the true depth."""
    note: str = ""
    """What went wrong, for people."""


COLUMNS = tuple(field.name for field in fields(FrameRow))
_NUMBERS = tuple(field.name for field in fields(FrameRow) if field.default is NAN)


def write_rows(path: Path, rows: Iterable[tuple[dict[str, str], FrameRow]]) -> None:
    """Write a CSV; NaN is an empty cell, numbers keep all their digits.

    Args:
        path: Written beside and renamed into place.
        rows: Further leading columns, the same for every row, and the row.
    """
    beside = path.with_name(f".{path.name}.part")
    with beside.open("w", newline="") as file:
        writer: Any = None
        for leading, row in rows:
            record: dict[str, object] = {**leading, **asdict(row)}
            record |= {name: "" if record[name] != record[name] else repr(record[name]) for name in _NUMBERS}
            if writer is None:
                writer = csv.DictWriter(file, list(record), lineterminator="\n")
                writer.writeheader()
            writer.writerow(record)
        if writer is None:
            csv.writer(file, lineterminator="\n").writerow(COLUMNS)
    beside.replace(path)


def read_rows(path: Path) -> Iterator[tuple[dict[str, str], FrameRow]]:
    """The rows of :func:`write_rows`, with the further columns.

    Raises:
        ResultError: If the file is no such CSV; names the line.
    """
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        missing = set(COLUMNS) - set(reader.fieldnames or ())
        if missing:
            raise ResultError(f"{path}: no per-frame table; the columns {', '.join(sorted(missing))} are missing")
        for record in reader:
            try:
                yield {k: v for k, v in record.items() if k not in COLUMNS}, _row(record)
            except (ValueError, TypeError) as error:
                raise ResultError(f"{path}, line {reader.line_num}: {error}") from error


def _row(record: dict[str, str]) -> FrameRow:
    values: dict[str, Any] = {name: float(record[name]) if record[name] else NAN for name in _NUMBERS}
    values |= {"index": int(record["index"]), "pixels": int(record["pixels"]), "frame": record["frame"]}
    return FrameRow(**values, status=Status(record["status"]), note=record["note"])

"""Two evaluations frame by frame: where one is better, by how much, and whether that could be chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bathyscope.camera import F64
from bathyscope.errors import ResultError, SettingsError
from bathyscope_train.evaluation.frame_rows import FrameRow, read_rows
from bathyscope_train.evaluation.intervals import Averaging, bootstrap_interval, grand_mean
from bathyscope_train.evaluation.runs.folder import RunFolder
from bathyscope_train.evaluation.runs.records import ALL_FRAMES

Key = tuple[str, str, str]
"""Data set, sequence, name of the frame."""
FEWEST_SEQUENCES = 6
"""Below this a signed-rank test over sequences cannot reach p < 0.05 (two-sided)."""


@dataclass(frozen=True)
class Side:
    """One system of one evaluation."""

    run: Path
    system: str
    protocol_hash: str
    rows: dict[Key, FrameRow]

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.system} of {self.run}"


@dataclass(frozen=True)
class SequenceDifference:
    """One sequence: means of both sides over the frames that both measured."""

    name: str
    frames: int
    first: float
    second: float


@dataclass(frozen=True)
class Comparison:
    """The second side minus the first, over the frames that both measured."""

    metric: str
    first: str
    second: str
    frames: int
    only_first: int
    """Frames that only the first measured."""
    only_second: int
    sequences: tuple[SequenceDifference, ...]
    means: tuple[float, float]
    difference: float
    interval: tuple[float, float] | None
    """95 %, paired bootstrap over sequences; ``None`` for a single sequence."""
    frame_p: float
    """Two-sided Wilcoxon signed-rank over frames: too sure of itself, because neighbouring frames are alike."""
    sequence_p: float | None
    """The same over sequence means; ``None`` for fewer than six sequences."""
    largest: tuple[tuple[str, float, float], ...]
    """Frames with the largest differences: name, first, second."""


def open_side(run: Path, system: str | None) -> Side:
    """One system of a finished evaluation.

    Args:
        run: Output folder of ``bathyscope evaluate``.
        system: Its label; may be left out where there is one only.

    Raises:
        ResultError: If the folder holds no evaluation.
        SettingsError: If the system is not in it, or none was named and there are several.
    """
    state, table = RunFolder(run).state(), run / "per_frame.csv"
    if not table.is_file():
        raise ResultError(f"{table}: missing; the evaluation was not finished, run the same command again")
    rows: dict[str, dict[Key, FrameRow]] = {}
    for leading, row in read_rows(table):
        if leading["group"] == ALL_FRAMES:
            rows.setdefault(leading["system"], {})[leading["dataset"], leading["sequence"], row.frame] = row
    if system is None and len(rows) != 1:
        raise SettingsError(f"{run} holds {', '.join(rows) or 'no system'}; name one with --systems FIRST SECOND")
    chosen = next(iter(rows)) if system is None else system
    if chosen not in rows:
        raise SettingsError(f"{run} holds no numbers of {chosen}; it holds {', '.join(rows) or 'none'}")
    return Side(run, chosen, state.protocol_hash, rows[chosen])


def compare(
    first: Side, second: Side, metric: str = "abs_rel", averaging: Averaging = "sequences", show: int = 5
) -> Comparison:
    """Compare frame by frame.

    Args:
        first: What to compare with.
        second: What is compared.
        metric: A number of the per-frame table.
        averaging: How means are taken.
        show: How many of the largest differences to name.

    Raises:
        SettingsError: If the protocols differ, or no frame was measured by both.
    """
    if first.protocol_hash != second.protocol_hash:
        raise SettingsError(
            f"{first.run} and {second.run} were evaluated under different protocols ({first.protocol_hash}, "
            f"{second.protocol_hash}); their numbers cannot be compared"
        )
    values = [{key: float(getattr(row, metric)) for key, row in side.rows.items()} for side in (first, second)]
    known = [{key for key, value in part.items() if not np.isnan(value)} for part in values]
    both = [key for key in values[0] if key in known[0] & known[1]]
    if not both:
        raise SettingsError(f"no frame has {metric} in both {first.name} and {second.name}")
    x, y = (np.array([part[key] for key in both]) for part in values)
    sequences = _by_sequence(both, x, y)
    differences = [b - a for _, a, b in sequences]
    means = (grand_mean([a for _, a, _ in sequences], averaging), grand_mean([b for _, _, b in sequences], averaging))
    order = np.argsort(-np.abs(y - x))[:show]
    return Comparison(
        metric=metric,
        first=first.name,
        second=second.name,
        frames=len(both),
        only_first=len(known[0] - known[1]),
        only_second=len(known[1] - known[0]),
        sequences=tuple(SequenceDifference(name, len(a), float(a.mean()), float(b.mean())) for name, a, b in sequences),
        means=means,
        difference=grand_mean(differences, averaging),
        interval=bootstrap_interval(differences, averaging),
        frame_p=signed_rank(y - x),
        sequence_p=_sequence_p(differences),
        largest=tuple(("/".join(both[i]), float(x[i]), float(y[i])) for i in order),
    )


def signed_rank(differences: F64) -> float:
    """Two-sided p of Wilcoxon's signed-rank test; 1 where nothing differs."""
    from scipy import stats

    if not np.any(differences):
        return 1.0
    return float(stats.wilcoxon(differences).pvalue)


def _sequence_p(differences: Sequence[F64]) -> float | None:
    if len(differences) < FEWEST_SEQUENCES:
        return None
    return signed_rank(np.array([part.mean() for part in differences]))


def _by_sequence(keys: Sequence[Key], x: F64, y: F64) -> list[tuple[str, F64, F64]]:
    places: dict[str, list[int]] = {}
    for place, (dataset, sequence, _) in enumerate(keys):
        places.setdefault(f"{dataset}/{sequence}", []).append(place)
    return [(name, x[chosen], y[chosen]) for name, chosen in places.items()]

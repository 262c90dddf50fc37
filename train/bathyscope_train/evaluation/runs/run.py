"""A whole evaluation: every system on every sequence of every data set, then tables and plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bathyscope.errors import BathyscopeError
from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.runs.folder import RunFolder
from bathyscope_train.evaluation.runs.jobs import Job, Progress, run_job, viewed
from bathyscope_train.evaluation.runs.names import DataName, SystemText
from bathyscope_train.evaluation.runs.records import SequenceRecord
from bathyscope_train.evaluation.sequences import EvaluationSet
from bathyscope_train.systems.registry import Unavailable, open_system
from bathyscope_train.systems.system import System


@dataclass(frozen=True)
class RunRequest:
    """What the user wants."""

    protocol: Protocol
    data: tuple[DataName, ...]
    systems: tuple[SystemText, ...]
    out: Path
    corrected: Path | None = None
    max_frames: int | None = None
    keep_predictions: bool = False


@dataclass(frozen=True)
class SystemOutcome:
    """One row of the table: records by data set and sequence, or why there are none."""

    label: str
    missing: str | None = None
    """``weights not available: ...``, or why it could not be opened."""
    records: dict[str, dict[str, SequenceRecord]] = field(default_factory=dict)
    unavailable: bool = False
    """Whether its weights are not at hand, which is an outcome and no failure."""


@dataclass(frozen=True)
class RunOutcome:
    """All that tables are made of."""

    folder: RunFolder
    protocol: Protocol
    data: dict[str, EvaluationSet]
    systems: tuple[SystemOutcome, ...]

    @property
    def failed(self) -> bool:
        """Whether something went wrong beyond weights that are not at hand."""
        absent = {system.label for system in self.systems if system.unavailable}
        return len(self.problems) > len(absent)

    @property
    def problems(self) -> list[str]:
        """Everything that went wrong, named: sequences that failed, gaps of data sets, systems that did not open."""
        found = [f"{system.label}: {system.missing}" for system in self.systems if system.missing is not None]
        for label, chosen in self.data.items():
            found += [f"{label}/{gap.sequence} {gap.what}".rstrip() + f": {gap.reason}" for gap in chosen.gaps]
        for system in self.systems:
            for record in (record for part in system.records.values() for record in part.values()):
                where = f"{system.label} on {record.dataset}/{record.sequence}"
                if record.failure is not None:
                    found.append(f"{where}: failed: {record.failure}")
                found += [
                    f"{where}, {name} frames: {group.outcome}"
                    for name, group in record.groups.items()
                    if group.outcome != "measured"
                ]
        return found


def run(request: RunRequest, progress: Progress = lambda *_: None) -> RunOutcome:
    """Measure what is not measured yet.

    Args:
        request: What is wanted.
        progress: Told about every frame.

    Raises:
        DatasetError: If a data set is not there; before anything is measured.
        SettingsError: If the output folder holds an evaluation of something else, or a name is not known.
    """
    folder = RunFolder(request.out)
    data = {name.label: name.open(request.protocol, request.corrected) for name in request.data}
    folder.claim(request.protocol, data, list(request.systems), request.max_frames)
    outcomes = []
    for text in request.systems:
        jobs = [
            Job(text.label, label, viewed(sequence, request.protocol, request.max_frames), folder)
            for label, chosen in data.items()
            for sequence in chosen.sequences
        ]
        outcomes.append(_run_system(text, jobs, request, progress))
    return RunOutcome(folder, request.protocol, data, tuple(outcomes))


def _run_system(text: SystemText, jobs: Sequence[Job], request: RunRequest, progress: Progress) -> SystemOutcome:
    """Open the system only if a job of it is left to do."""
    records: dict[str, dict[str, SequenceRecord]] = {job.dataset: {} for job in jobs}
    system: System | Unavailable | None = None
    for job in jobs:
        record = job.record
        if record is None:
            if system is None:
                try:
                    system = open_system(text.text)
                except BathyscopeError as error:
                    return SystemOutcome(text.label, f"cannot be opened: {error}", records)
            if isinstance(system, Unavailable):
                return SystemOutcome(text.label, system.reason, unavailable=True)
            record = run_job(job, system, request.protocol, request.keep_predictions, progress)
        records[job.dataset][job.sequence.name] = record
    return SystemOutcome(text.label, None, records)

"""The folder of one evaluation: what it was asked for, and where each part lies.

::

    OUT/run.json                                 protocol, data sets with split hashes, systems with fingerprints
    OUT/jobs/SYSTEM/DATA/SEQUENCE/record.json    what was measured; written last, so its presence means done
                                  rows.csv       per frame; rows.GROUP.csv for each named choice of frames
                                  example.npz    one frame for the qualitative picture
                                  poses.txt      predicted cameras in TUM order, where the system has any
    OUT/predictions/...                          raw predictions while a sequence is measured
    OUT/per_frame.csv, per_sequence.csv, summary.md, summary.tex, summary.json, plots/
    OUT/published.txt                            what public evaluators would have printed, with the quirk student-t
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from bathyscope.errors import ResultError, SettingsError
from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.runs.names import SystemText
from bathyscope_train.evaluation.sequences import EvaluationSet


class DataState(BaseModel, frozen=True, extra="forbid"):
    """A data set as it was when it was measured."""

    split: str
    split_hash: str
    sequences: int
    frames: int


class RunState(BaseModel, frozen=True, extra="forbid"):
    """``run.json``."""

    protocol: str
    protocol_hash: str
    words: tuple[str, ...]
    max_frames: int | None
    data: dict[str, DataState]
    systems: dict[str, str]
    """Fingerprint of each system by its label."""


@dataclass(frozen=True)
class RunFolder:
    """One evaluation on disk."""

    path: Path

    def job(self, system: str, dataset: str, sequence: str) -> Path:
        """Folder of one system on one sequence."""
        return self.path / "jobs" / safe(system) / safe(dataset) / safe(sequence)

    def predictions(self, system: str, dataset: str, sequence: str) -> Path:
        """Where raw predictions lie while they are needed."""
        return self.path / "predictions" / safe(system) / safe(dataset) / safe(sequence)

    def claim(
        self,
        protocol: Protocol,
        data: dict[str, EvaluationSet],
        systems: list[SystemText],
        max_frames: int | None,
    ) -> RunState:
        """Begin, or go on with what an earlier call began.

        Systems and data sets may be added to an evaluation; nothing that it measured already may have changed.

        Raises:
            SettingsError: If it was made under another protocol, or a data set or system is another now; says which.
        """
        old = self.state() if (self.path / "run.json").is_file() else None
        states = {
            label: DataState(
                split=chosen.split,
                split_hash=chosen.split_hash,
                sequences=len(chosen.sequences),
                frames=chosen.frame_count,
            )
            for label, chosen in data.items()
        }
        prints = {system.label: system.fingerprint() for system in systems}
        if old is not None:
            self._refuse_changes(old, protocol, max_frames, states, prints)
        state = RunState(
            protocol=protocol.name,
            protocol_hash=protocol.hash,
            words=protocol.words(),
            max_frames=max_frames,
            data=states if old is None else {**old.data, **states},
            systems=prints if old is None else {**old.systems, **prints},
        )
        self.path.mkdir(parents=True, exist_ok=True)
        write_text(self.path / "run.json", state.model_dump_json(indent=1))
        return state

    def state(self) -> RunState:
        """What was asked for.

        Raises:
            ResultError: If the folder holds no evaluation.
        """
        path = self.path / "run.json"
        try:
            return RunState.model_validate_json(path.read_bytes())
        except FileNotFoundError as error:
            raise ResultError(f"{self.path}: no evaluation in it (run.json is missing)") from error
        except ValidationError as error:
            raise ResultError(f"{path}: not written by `bathyscope evaluate` ({error})") from error

    def _refuse_changes(
        self,
        old: RunState,
        protocol: Protocol,
        max_frames: int | None,
        data: dict[str, DataState],
        systems: dict[str, str],
    ) -> None:
        """Numbers of different making never meet in one table."""
        changes = []
        if (old.protocol_hash, old.max_frames) != (protocol.hash, max_frames):
            changes.append(f"protocol {old.protocol} ({old.protocol_hash}), frames {old.max_frames or 'all'}")
        changes += [f"data set {name}" for name, state in data.items() if old.data.get(name, state) != state]
        changes += [f"system {name}" for name, print_ in systems.items() if old.systems.get(name, print_) != print_]
        if changes:
            raise SettingsError(
                f"{self.path} holds an evaluation of something else: {'; '.join(changes)} differ now; "
                "give another --out, or remove it"
            )


def safe(name: str) -> str:
    """A name as one part of a path; names that differ stay different."""
    return re.sub(r"[^A-Za-z0-9@._+-]", lambda match: f"%{ord(match.group()):02x}", name).replace("..", "%2e%2e")


def write_text(path: Path, text: str) -> None:
    """Write beside and rename into place."""
    beside = path.with_name(f".{path.name}.part")
    beside.write_text(text)
    beside.replace(path)


def write_json(path: Path, value: object) -> None:
    """The same, as JSON without NaN."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False))

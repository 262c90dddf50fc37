"""What an evaluation keeps of one system on one sequence, as JSON beside its per-frame CSV."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ValidationError

from bathyscope.errors import ResultError
from bathyscope_train.evaluation.measure import MEASURED
from bathyscope_train.evaluation.reports import FocalScores, PoseScores
from bathyscope_train.systems.system import SystemInfo

ALL_FRAMES = "all"


class GroupRecord(BaseModel, frozen=True, extra="forbid"):
    """All frames of a sequence, or a named choice of them."""

    outcome: str
    """``measured``, or why there is no number."""
    unit: str
    caps: tuple[float, float | None]
    """In ``unit``; no upper cap is null."""
    frames: int
    measured: int
    scale: float | None = None
    """Of the sequence's alignment; null where every frame has its own."""
    shift: float | None = None
    lengths: tuple[float, float, float, float] | None = None
    """Of robust scale and shift: median and mean absolute deviation of truth, then of prediction."""
    by_depth: dict[str, list[float]] | None = None


class SequenceRecord(BaseModel, frozen=True, extra="forbid"):
    """One system on one sequence."""

    system: str
    dataset: str
    sequence: str
    info: SystemInfo | None = None
    """Null if the system failed before it could say."""
    failure: str | None = None
    """Why there is no prediction; such a record is tried again."""
    groups: dict[str, GroupRecord] = {}
    poses: PoseScores | None = None
    focal: FocalScores | None = None
    predict_ms: float | None = None
    """Per frame."""
    measure_ms: float | None = None
    """Per frame, over all passes."""

    @property
    def measured(self) -> bool:
        """Whether there is a number."""
        return ALL_FRAMES in self.groups and self.groups[ALL_FRAMES].outcome == MEASURED

    def write(self, path: Path) -> None:
        """Written beside and renamed into place."""
        beside = path.with_name(f".{path.name}.part")
        beside.write_text(self.model_dump_json(indent=1))
        beside.replace(path)

    @classmethod
    def read(cls, path: Path) -> SequenceRecord | None:
        """``None`` if there is none yet.

        Raises:
            ResultError: If there is one that cannot be read.
        """
        try:
            return cls.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except ValidationError as error:
            raise ResultError(f"{path}: not a record of an evaluation ({error}); remove it to measure again") from error

"""One system on one sequence: predict, measure, write down. Done jobs are never done again."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bathyscope.camera import F64
from bathyscope.errors import BathyscopeError, DatasetError, SettingsError
from bathyscope.tum import tum_lines
from bathyscope_train.evaluation.estimates import StoredEstimates, open_estimates, store_estimates
from bathyscope_train.evaluation.evaluate import FRAME_GAP
from bathyscope_train.evaluation.frame_rows import write_rows
from bathyscope_train.evaluation.measure import Measurement, measure
from bathyscope_train.evaluation.poses import TruePoses, pose_scores
from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.reports import FocalScores, PoseScores
from bathyscope_train.evaluation.runs.folder import RunFolder, write_text
from bathyscope_train.evaluation.runs.records import ALL_FRAMES, GroupRecord, SequenceRecord
from bathyscope_train.evaluation.sequence_views import FRAME_RATE, SequenceView
from bathyscope_train.evaluation.sequences import EvaluationSequence
from bathyscope_train.systems.system import System

Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how many of how many frames are."""


@dataclass(frozen=True)
class Job:
    """What is to be measured, and where it goes."""

    system: str
    dataset: str
    sequence: SequenceView
    run: RunFolder

    @property
    def folder(self) -> Path:
        """Where its files go."""
        return self.run.job(self.system, self.dataset, self.sequence.name)

    @property
    def record(self) -> SequenceRecord | None:
        """What an earlier call measured; ``None`` if it is still to be done, or failed."""
        found = SequenceRecord.read(self.folder / "record.json")
        return found if found is not None and found.failure is None else None


def viewed(sequence: EvaluationSequence, protocol: Protocol, max_frames: int | None) -> SequenceView:
    """The sequence as the protocol wants it seen."""
    return SequenceView(sequence, sequence.published_crop if protocol.crop else None, max_frames)


def run_job(job: Job, system: System, protocol: Protocol, keep: bool, progress: Progress) -> SequenceRecord:
    """Predict and measure; failures become part of the record.

    Args:
        job: What and where.
        system: Opened.
        protocol: How to measure.
        keep: Leave the raw predictions in the folder.
        progress: Told about every frame.
    """
    shutil.rmtree(job.folder, ignore_errors=True)
    job.folder.mkdir(parents=True)
    store = job.run.predictions(job.system, job.dataset, job.sequence.name)
    try:
        record = _run(job, system, protocol, store, progress)
    except BathyscopeError as error:
        record = SequenceRecord(
            system=job.system,
            dataset=job.dataset,
            sequence=job.sequence.name,
            info=system.info,
            failure=str(error),
        )
    if not keep and record.failure is None:
        shutil.rmtree(store, ignore_errors=True)
    record.write(job.folder / "record.json")
    return record


def _run(job: Job, system: System, protocol: Protocol, store: Path, progress: Progress) -> SequenceRecord:
    if protocol.alignment == "none" and system.info.scale != "metric":
        raise SettingsError(f"{job.system} gives {system.info.scale} {system.info.quantity}, which needs an alignment")
    frames = len(job.sequence)
    what = f"{job.system} on {job.dataset}/{job.sequence.name}"
    known = job.sequence.intrinsics if protocol.intrinsics == "known" else None
    estimates, predict_s = _predicted(
        job, system, known, store, lambda done: progress(f"{what}: predicting", done, frames)
    )
    start = time.perf_counter()
    groups = {}
    for group in (ALL_FRAMES, *job.sequence.groups):
        if group != ALL_FRAMES and not job.sequence.groups[group].any():
            continue
        chosen = None if group == ALL_FRAMES else group
        found = measure(
            job.sequence,
            estimates,
            protocol,
            group=chosen,
            progress=lambda done: progress(f"{what}: measuring", done, frames),
        )
        suffix = "" if chosen is None else f".{group}"
        leading = {"system": job.system, "dataset": job.dataset, "sequence": job.sequence.name, "group": group}
        write_rows(job.folder / f"rows{suffix}.csv", ((leading, row) for row in found.rows))
        if chosen is None and found.example is not None:
            found.example.save(job.folder / "example.npz")
        groups[group] = _group_record(found)
    return SequenceRecord(
        system=job.system,
        dataset=job.dataset,
        sequence=job.sequence.name,
        info=system.info,
        groups=groups,
        poses=_poses(job, estimates, groups[ALL_FRAMES].scale),
        focal=_focal(estimates.intrinsics, job.sequence.intrinsics),
        predict_ms=None if predict_s is None else 1e3 * predict_s / frames,
        measure_ms=1e3 * (time.perf_counter() - start) / frames,
    )


def _predicted(
    job: Job, system: System, intrinsics: F64 | None, store: Path, progress: Callable[[int], None]
) -> tuple[StoredEstimates, float | None]:
    """Predictions, from disk if an earlier call finished them, and the seconds that they took now."""
    sequence, info = job.sequence, system.info
    key = f"{info.model_dump_json()} {sequence.name} {len(sequence)} {sequence.size} {sequence.crop} {intrinsics}"
    found = open_estimates(store, key)
    if found is not None:
        return found, None
    if len(sequence) == 0:
        raise DatasetError(f"{sequence.name}: no frames")
    shape = (len(sequence), *sequence.size)
    start = time.perf_counter()
    for done in store_estimates(store, key, info, shape, system.estimate(sequence, intrinsics)):
        progress(done)
    finished = open_estimates(store, key)
    assert finished is not None
    return finished, time.perf_counter() - start


def _group_record(found: Measurement) -> GroupRecord:
    low, high = found.caps
    alignment = found.alignment
    return GroupRecord(
        outcome=found.outcome,
        unit=found.unit,
        caps=(low, high if np.isfinite(high) else None),
        frames=len(found.rows),
        measured=sum(row.pixels > 0 for row in found.rows),
        scale=None if alignment is None else alignment.scale,
        shift=None if alignment is None else alignment.shift,
        lengths=None if alignment is None else alignment.lengths,
        by_depth=found.by_depth.as_dict(),
    )


def _poses(job: Job, estimates: StoredEstimates, depth_scale: float | None) -> PoseScores | None:
    """Scores of predicted cameras; they are written in TUM order whether there is truth or not."""
    predicted, true = estimates.world_from_camera, job.sequence.world_from_camera
    if predicted is None:
        return None
    stamps = np.arange(len(predicted)) / FRAME_RATE
    write_text(job.folder / "poses.txt", "".join(tum_lines(stamps, predicted)))
    if true is None:
        return None
    unit = job.sequence.depth_unit
    poses = TruePoses(true, job.sequence.pose_unit, unit if unit == "arbitrary" else "mm")
    return pose_scores(poses, predicted, estimates.segment, FRAME_GAP, depth_scale)


def _focal(predicted: F64 | None, true: F64 | None) -> FocalScores | None:
    """Median over frames of predicted over true focal length."""
    if predicted is None or true is None:
        return None
    ratios = np.median(predicted[:, [0, 1], [0, 1]], axis=0) / true[[0, 1], [0, 1]]
    return FocalScores(fx_ratio=float(ratios[0]), fy_ratio=float(ratios[1]))

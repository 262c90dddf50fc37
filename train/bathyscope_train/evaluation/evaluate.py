"""Measure a bundle on data set folders, beside guesses that need no network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.engines import DepthOptions, Engine
from bathyscope.errors import DatasetError
from bathyscope.result import ResultMeta
from bathyscope_train.evaluation.alignment import median_scale
from bathyscope_train.evaluation.baselines import brightness_depth, constant_depth
from bathyscope_train.evaluation.folders import DatasetFolder
from bathyscope_train.evaluation.metrics import NAMES, UNITS_OF_DEPTH, depth_errors, mean_errors
from bathyscope_train.evaluation.poses import TruePoses, pose_scores
from bathyscope_train.evaluation.reports import (
    Counts,
    DepthScores,
    EvaluationReport,
    FocalScores,
    FolderReport,
    NetworkReport,
    Protocol,
)

DepthKind = Literal["rendered", "head"]
Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how many of how many frames are."""
FRAME_GAP = 6
"""Frames between the cameras of a pair: the paper's stride."""


Samples = list[NDArray[np.floating]]
"""Depth at the pixels of the truth: (n,) for each frame; 0 where nothing was predicted."""


@dataclass(frozen=True)
class Prediction:
    """What the engine says of a folder."""

    depth: Samples
    cameras: tuple[F64, F64] | None
    """``world_from_camera`` and intrinsics of every frame; ``None`` from a model without cameras."""
    segment: NDArray[np.int32]
    meta: ResultMeta


def evaluate(
    engine: Engine,
    folders: Sequence[Path],
    *,
    kinds: Sequence[DepthKind] = ("rendered", "head"),
    gap: int = FRAME_GAP,
    max_frames: int | None = None,
    progress: Progress = lambda *_: None,
) -> EvaluationReport:
    """Measure every folder.

    Args:
        engine: The loaded bundle.
        folders: Data set folders.
        kinds: Which depth outputs of the network to compare.
        gap: Frames between the two cameras of a pair in pose errors.
        max_frames: Use only the first frames of each folder.
        progress: Told about every frame.

    Raises:
        DatasetError: If a folder cannot be used. All folders are opened before the first is measured.
    """
    opened = [DatasetFolder.open(folder) for folder in folders]
    reports = [
        evaluate_folder(engine, folder, kinds=kinds, gap=gap, max_frames=max_frames, progress=progress)
        for folder in opened
    ]
    return EvaluationReport(
        bundle=engine.bundle.id,
        software=f"bathyscope {version('bathyscope')}",
        protocol=Protocol(frame_gap=gap),
        datasets=reports,
        mean=_mean_over_folders(reports),
    )


def evaluate_folder(
    engine: Engine,
    folder: DatasetFolder,
    *,
    kinds: Sequence[DepthKind] = ("rendered", "head"),
    gap: int = FRAME_GAP,
    max_frames: int | None = None,
    progress: Progress = lambda *_: None,
) -> FolderReport:
    """Measure one folder; see :func:`evaluate`."""
    frames = len(folder.frames) if max_frames is None else min(max_frames, len(folder.frames))
    truth, guesses = _read_truth(folder, frames, progress)
    if not any(len(depth) for depth in truth):
        raise DatasetError(f"{folder.path}: no pixel of its {frames} frames has true depth inside depth_valid")
    predictions = {kind: _predict(engine, folder, kind, frames, progress) for kind in kinds}
    common = [np.logical_and.reduce([predictions[kind].depth[t] > 0 for kind in kinds]) for t in range(frames)]
    if not any(keep.any() for keep in common):
        raise DatasetError(f"{folder.path}: the network predicts depth at none of the pixels with true depth")
    return FolderReport(
        dataset=folder.name,
        truth=cast(Literal["dense", "sparse"], folder.truth.kind),
        unit=folder.calibration.depth_unit or "unknown",
        counts=Counts(
            frames=frames,
            frames_with_truth=sum(bool(keep.any()) for keep in common),
            pixels_with_truth=sum(len(depth) for depth in truth),
            pixels=sum(int(keep.sum()) for keep in common),
        ),
        network={kind: _network_report(folder, truth, predictions[kind], common, gap) for kind in kinds},
        baselines={name: depth_scores(truth, samples, common) for name, samples in guesses.items()},
    )


def depth_scores(
    truth: Sequence[F64], predicted: Sequence[NDArray[np.floating]], keep: Sequence[NDArray[np.bool_]]
) -> DepthScores:
    """Scores of one row: median scale for the clip, errors for each frame, mean over frames.

    Args:
        truth: True depth (n,) of each frame.
        predicted: Predicted depth (n,) of the same pixels; 0 where there is none.
        keep: Which of these pixels count, (n,) for each frame.
    """
    g = [values[mask] for values, mask in zip(truth, keep, strict=True)]
    p = [np.asarray(values[mask], np.float64) for values, mask in zip(predicted, keep, strict=True)]
    scale = median_scale(g, p)
    errors = mean_errors([depth_errors(a, scale * b) for a, b in zip(g, p, strict=True)])
    total = sum(len(values) for values in truth)
    covered = sum(int((values > 0).sum()) for values in predicted)
    return DepthScores(**errors.as_dict(), scale=scale, coverage=covered / total)


def _read_truth(folder: DatasetFolder, frames: int, progress: Progress) -> tuple[list[F64], dict[str, Samples]]:
    truth: list[F64] = []
    constant: Samples = []
    brightness: Samples = []
    for t in range(frames):
        known, image = folder.truth.at(t), folder.image(t)
        truth.append(known.depth)
        constant.append(constant_depth(image)[known.rows, known.columns])
        brightness.append(brightness_depth(image)[known.rows, known.columns].astype(np.float32))
        progress(f"{folder.name}: reading", t + 1, frames)
    return truth, {"constant": constant, "inverse_sqrt_brightness": brightness}


def _predict(engine: Engine, folder: DatasetFolder, kind: DepthKind, frames: int, progress: Progress) -> Prediction:
    """Run the engine and keep of each depth map only the pixels of the truth."""
    samples: Samples = []
    poses: list[F64] = []
    intrinsics: list[F64] = []
    segment: list[int] = []
    run = engine.run(folder.path / "frames", DepthOptions(depth=kind, max_frames=frames), name=folder.name)
    try:
        for frame in run:
            if frame.depth.shape != folder.calibration.size:
                raise DatasetError(f"{folder.path}: depth came back as {frame.depth.shape}, not of the frames' size")
            known = folder.truth.at(len(segment))
            values = np.where(frame.valid, frame.depth, 0.0)[known.rows, known.columns]
            samples.append(values.astype(np.float32))
            if frame.world_from_camera is not None and frame.intrinsics is not None:
                poses.append(frame.world_from_camera)
                intrinsics.append(frame.intrinsics)
            segment.append(frame.segment)
            progress(f"{folder.name}: {kind} depth", len(segment), frames)
        meta = run.meta()
    finally:
        run.close()
    if len(segment) != frames:
        raise DatasetError(
            f"{folder.path}: {frames} frames went in, {len(segment)} came back: {'; '.join(meta.warnings)}"
        )
    if "disparity" in meta.outputs:
        samples = [np.divide(1, part, out=np.zeros_like(part), where=part > 0) for part in samples]
    cameras = (np.stack(poses), np.stack(intrinsics)) if len(poses) == frames else None
    return Prediction(samples, cameras, np.array(segment, np.int32), meta)


def _network_report(
    folder: DatasetFolder,
    truth: list[F64],
    prediction: Prediction,
    keep: Sequence[NDArray[np.bool_]],
    gap: int,
) -> NetworkReport:
    depth = depth_scores(truth, prediction.depth, keep)
    true = folder.calibration
    poses, focal = None, None
    if prediction.cameras is not None:
        world_from_camera, intrinsics = prediction.cameras
        true_poses = TruePoses(folder.world_from_camera, true.pose_unit, true.depth_unit)
        poses = pose_scores(true_poses, world_from_camera, prediction.segment, gap, depth.scale)
        focal = FocalScores(
            fx_ratio=float(np.median(intrinsics[:, 0, 0])) / true.fx,
            fy_ratio=float(np.median(intrinsics[:, 1, 1])) / true.fy,
        )
    segments = len(np.unique(prediction.segment))
    return NetworkReport(depth=depth, poses=poses, focal=focal, segments=segments, warnings=prediction.meta.warnings)


def _mean_over_folders(reports: Sequence[FolderReport]) -> dict[str, DepthScores]:
    """Plain mean of each row over the folders, for several folders."""
    if len(reports) < 2:
        return {}
    same_unit = len({report.unit for report in reports}) == 1
    rows = [_rows(report) for report in reports]
    return {name: _mean_scores([row[name] for row in rows], same_unit) for name in rows[0]}


def _rows(report: FolderReport) -> dict[str, DepthScores]:
    return {**{name: part.depth for name, part in report.network.items()}, **report.baselines}


def _mean_scores(scores: Iterable[DepthScores], same_unit: bool) -> DepthScores:
    table = [score.model_dump() for score in scores]
    means: dict[str, float | None] = {name: _mean([row[name] for row in table]) for name in (*NAMES, "coverage")}
    if not same_unit:
        means.update(dict.fromkeys(UNITS_OF_DEPTH))
    return DepthScores(**means, scale=None)


def _mean(values: Sequence[float | None]) -> float:
    return float(np.mean([value for value in values if value is not None]))

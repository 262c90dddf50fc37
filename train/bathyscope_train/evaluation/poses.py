"""Pose scores of a predicted trajectory on a data set folder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope_train.evaluation.folders import DatasetFolder
from bathyscope_train.evaluation.reports import PoseScores
from bathyscope_train.evaluation.trajectory import (
    TrajectoryErrors,
    frame_pairs,
    relative_motion,
    relative_pose_errors,
    trajectory_errors,
)

_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


def pose_scores(
    folder: DatasetFolder, predicted: F64, segment: NDArray[np.integer], gap: int, depth_scale: float | None
) -> PoseScores | None:
    """Scores of predicted poses (t, 4, 4), t at most the folder's frames; None where the folder has no poses.

    Args:
        folder: The truth.
        predicted: ``world_from_camera`` of the first t frames.
        segment: (t,) frames of one segment share one predicted world.
        gap: Frames between the cameras of a pair.
        depth_scale: True length of one unit of predicted depth.
    """
    frames = len(predicted)
    true, usable = folder.world_from_camera[:frames], folder.has_pose[:frames]
    if not usable.any():
        return None
    pairs = frame_pairs(usable, segment, gap)
    relative = relative_motion(true, predicted, pairs)
    aligned = _align_segments(true, predicted, usable, segment)
    largest = max(aligned, key=lambda part: part[0], default=None)
    scale = float("nan") if largest is None else largest[1].scale
    rpe_translation, rpe_rotation = relative_pose_errors(true, predicted, pairs, scale)
    return PoseScores(
        unit=folder.calibration.pose_unit or "unknown",
        gap=gap,
        pairs=len(pairs),
        rotation_error_deg_mean=_mean(relative.rotation_error_deg),
        rotation_error_deg_median=_median(relative.rotation_error_deg),
        true_rotation_deg_mean=_mean(relative.true_rotation_deg),
        true_translation_mean=_mean(relative.true_translation),
        direction_cosine_mean=_mean(relative.direction_cosine),
        direction_cosine_median=_median(relative.direction_cosine),
        rpe_translation=rpe_translation,
        rpe_rotation_deg=rpe_rotation,
        ate_rmse=_pooled([(n, part.ate_rmse) for n, part in aligned]),
        ate_standing_still=_pooled([(n, part.standing_still) for n, part in aligned]),
        aligned_frames=sum(n for n, _ in aligned),
        pose_scale_over_depth_scale=_scale_agreement(folder, scale, depth_scale),
    )


def _align_segments(
    true: F64, predicted: F64, usable: NDArray[np.bool_], segment: NDArray[np.integer]
) -> list[tuple[int, TrajectoryErrors]]:
    """Number of frames and errors of each segment that is long enough to align."""
    parts = []
    for number in np.unique(segment):
        mine = usable & (segment == number)
        if mine.sum() >= 3:
            parts.append((int(mine.sum()), trajectory_errors(true[mine], predicted[mine])))
    return parts


def _pooled(parts: list[tuple[int, float]]) -> float:
    total = sum(n for n, _ in parts)
    return float(np.sqrt(sum(n * value**2 for n, value in parts) / total)) if total else float("nan")


def _scale_agreement(folder: DatasetFolder, pose_scale: float, depth_scale: float | None) -> float | None:
    """How many times longer a predicted unit is by the poses than by the depth."""
    depth_unit, pose_unit = folder.calibration.depth_unit, folder.calibration.pose_unit
    if depth_scale is None or not np.isfinite(pose_scale) or depth_unit is None or pose_unit is None:
        return None
    if depth_unit == pose_unit:
        return pose_scale / depth_scale
    if depth_unit in _MILLIMETRES and pose_unit in _MILLIMETRES:
        return pose_scale * _MILLIMETRES[pose_unit] / (depth_scale * _MILLIMETRES[depth_unit])
    return None


def _mean(values: F64) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def _median(values: F64) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else float("nan")

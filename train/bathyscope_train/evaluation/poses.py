"""Pose scores of a predicted trajectory against true poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, invert_pose
from bathyscope_train.evaluation.reports import PoseScores
from bathyscope_train.evaluation.snippets import SNIPPET_FRAMES, SnippetErrors, relative_poses, snippet_errors
from bathyscope_train.evaluation.trajectory import (
    TrajectoryErrors,
    frame_pairs,
    relative_motion,
    relative_pose_errors,
    trajectory_errors,
)

_MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}


@dataclass(frozen=True)
class TruePoses:
    """What is known of the camera of a sequence."""

    world_from_camera: F64
    """(t, 4, 4), NaN for frames without a pose."""
    unit: str | None
    """Of their positions."""
    depth_unit: str | None
    """Of the true depth of the same frames."""


def pose_scores(
    true_poses: TruePoses, predicted: F64, segment: NDArray[np.integer], gap: int, depth_scale: float | None
) -> PoseScores | None:
    """Scores of predicted poses (t, 4, 4), t at most the frames of the truth; None where no frame has a true pose.

    Args:
        true_poses: The truth.
        predicted: ``world_from_camera`` of the first t frames.
        segment: (t,) frames of one segment share one predicted world.
        gap: Frames between the cameras of a pair.
        depth_scale: True length of one unit of predicted depth.
    """
    frames = len(predicted)
    true = true_poses.world_from_camera[:frames]
    usable = np.asarray(np.isfinite(true).all(axis=(1, 2)))
    if not usable.any():
        return None
    pairs = frame_pairs(usable, segment, gap)
    relative = relative_motion(true, predicted, pairs)
    aligned = _align_segments(true, predicted, usable, segment)
    largest = max(aligned, key=lambda part: part[0], default=None)
    scale = float("nan") if largest is None else largest[1].scale
    rpe_translation, rpe_rotation = relative_pose_errors(true, predicted, pairs, scale)
    snippets = _snippets(true, predicted, usable, segment)
    return PoseScores(
        unit=true_poses.unit or "unknown",
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
        pose_scale_over_depth_scale=_scale_agreement(true_poses, scale, depth_scale),
        snippet_ate_mean=None if snippets is None else float(snippets.ate.mean()),
        snippet_rotation_deg_mean=None if snippets is None else float(np.degrees(snippets.rotation_rad.mean())),
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


def _snippets(
    true: F64, predicted: F64, usable: NDArray[np.bool_], segment: NDArray[np.integer]
) -> SnippetErrors | None:
    """Snippet errors where every frame has a pose and the prediction is one world; otherwise None."""
    if len(true) < SNIPPET_FRAMES or not usable.all() or len(np.unique(segment)) > 1:
        return None
    return snippet_errors(relative_poses(invert_pose(true)), relative_poses(invert_pose(predicted)))


def _scale_agreement(true_poses: TruePoses, pose_scale: float, depth_scale: float | None) -> float | None:
    """How many times longer a predicted unit is by the poses than by the depth."""
    depth_unit, pose_unit = true_poses.depth_unit, true_poses.unit
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

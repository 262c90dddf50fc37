"""How well predicted camera motion agrees with the truth.

All poses are ``world_from_camera`` (n, 4, 4); the two worlds may differ by any similarity. Relative motion over a
gap of frames needs no common world; only the lengths of translations need the common scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, invert_pose, rotation_angle
from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.alignment import align_positions, stands_still

_NO_MOTION = 1e-6
"""Translations below this share of the largest one have no direction worth comparing."""


@dataclass(frozen=True, slots=True)
class RelativeMotion:
    """Per pair of frames (i, i + gap); arrays (m,). The direction of a motion that is nothing has cosine NaN."""

    rotation_error_deg: F64
    """Angle between true and predicted relative rotation."""
    true_rotation_deg: F64
    """How far the camera truly turned: the error of predicting no rotation."""
    true_translation: F64
    """How far the camera truly moved, in the unit of the true poses."""
    direction_cosine: F64
    """Cosine between true and predicted translation, in the camera of frame i; 0 where the prediction stands still."""


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors after a Sim(3) alignment of camera positions."""

    ate_rmse: float
    """Root mean square distance between true and aligned positions, in the unit of the true poses."""
    standing_still: float
    """What a camera that never moves would get: root mean square distance of the true positions from their mean."""
    scale: float
    """True length of one predicted unit; 0 where the predicted camera stands still."""


def motion(world_from_camera: F64, pairs: NDArray[np.intp]) -> F64:
    """Relative poses (m, 4, 4): the later camera of each pair (m, 2), seen from the earlier one."""
    earlier, later = world_from_camera[pairs[:, 0]], world_from_camera[pairs[:, 1]]
    return np.asarray(invert_pose(earlier) @ later, np.float64)


def frame_pairs(usable: NDArray[np.bool_], segment: NDArray[np.integer], gap: int) -> NDArray[np.intp]:
    """Pairs (m, 2) of frames ``gap`` apart which both have poses, in one world.

    Args:
        usable: (t,) whether true and predicted pose of a frame are known.
        segment: (t,) frames of one segment share one predicted world.
        gap: Distance between the frames of a pair; at least 1.
    """
    if gap < 1:
        raise GeometryError(f"a frame gap of at least 1 is needed, got {gap}")
    first = np.arange(max(len(usable) - gap, 0), dtype=np.intp)
    keep = usable[first] & usable[first + gap] & (segment[first] == segment[first + gap])
    return np.stack([first[keep], first[keep] + gap], -1)


def relative_motion(true: F64, predicted: F64, pairs: NDArray[np.intp]) -> RelativeMotion:
    """Compare the motion between the frames of each pair.

    Args:
        true: Poses (t, 4, 4).
        predicted: Poses (t, 4, 4).
        pairs: Frame numbers (m, 2).
    """
    true_motion, predicted_motion = motion(true, pairs), motion(predicted, pairs)
    difference = np.swapaxes(true_motion[:, :3, :3], -1, -2) @ predicted_motion[:, :3, :3]
    lengths = np.linalg.norm(true_motion[:, :3, 3], axis=-1)
    return RelativeMotion(
        rotation_error_deg=np.degrees(rotation_angle(difference)),
        true_rotation_deg=np.degrees(rotation_angle(true_motion[:, :3, :3])),
        true_translation=lengths,
        direction_cosine=_cosines(true_motion[:, :3, 3], predicted_motion[:, :3, 3]),
    )


def relative_pose_errors(true: F64, predicted: F64, pairs: NDArray[np.intp], scale: float) -> tuple[float, float]:
    r"""Relative pose error (Sturm et al., IROS 2012), root mean square over the pairs.

    The error of a pair is :math:`E = (T_i^{-1} T_j)^{-1} (P_i^{-1} P_j)` with predicted translations times ``scale``.

    Returns:
        Length of the translation of E in the unit of the true poses, and its rotation in degrees; NaN without a pair.
    """
    if len(pairs) == 0:
        return float("nan"), float("nan")
    predicted_motion = motion(predicted, pairs)
    predicted_motion[:, :3, 3] *= scale
    error = invert_pose(motion(true, pairs)) @ predicted_motion
    translation = np.sqrt(np.mean((error[:, :3, 3] ** 2).sum(axis=-1)))
    rotation = np.sqrt(np.mean(np.degrees(rotation_angle(error[:, :3, :3])) ** 2))
    return float(translation), float(rotation)


def trajectory_errors(true: F64, predicted: F64) -> TrajectoryErrors:
    """Absolute trajectory error after the best Sim(3).

    A predicted camera that stands still is best scaled by 0, and a true one that does likewise: both then have the
    error of standing still.

    Args:
        true: Poses (n, 4, 4), n >= 3.
        predicted: Poses (n, 4, 4) of the same frames, in one world.

    Raises:
        GeometryError: If there are fewer than three poses, or their numbers differ.
    """
    if true.shape != predicted.shape or len(true) < 3:
        raise GeometryError(f"a trajectory error needs at least 3 pairs of poses, got {len(true)} and {len(predicted)}")
    positions, moved = true[:, :3, 3], predicted[:, :3, 3]
    spread = _root_mean_square(positions - positions.mean(axis=0))
    if stands_still(moved) or stands_still(positions):
        return TrajectoryErrors(ate_rmse=spread, standing_still=spread, scale=0.0)
    similarity = align_positions(moved, positions)
    return TrajectoryErrors(_root_mean_square(positions - similarity.points(moved)), spread, similarity.scale)


def _cosines(true: F64, predicted: F64) -> F64:
    true_length, length = np.linalg.norm(true, axis=-1), np.linalg.norm(predicted, axis=-1)
    largest = true_length.max(initial=0.0)
    product = (true * predicted).sum(axis=-1)
    moving = length > 0
    cosine = np.divide(product, true_length * length, out=np.zeros_like(product), where=moving & (true_length > 0))
    return np.where(true_length > _NO_MOTION * largest, cosine, np.nan)


def _root_mean_square(offsets: F64) -> float:
    return float(np.sqrt(np.mean((offsets**2).sum(axis=-1))))

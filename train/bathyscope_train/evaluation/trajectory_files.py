"""Pose scores of a trajectory file against another, both in TUM order: for cameras of anybody's making."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.errors import ResultError
from bathyscope.tum import read_tum
from bathyscope_train.evaluation.poses import TruePoses, pose_scores
from bathyscope_train.evaluation.reports import PoseScores

CLOSE_S = 0.02
"""Time stamps further apart belong to different frames: half a frame at 25 a second."""


def compare_files(true: Path, predicted: Path, *, gap: int, close_s: float = CLOSE_S) -> tuple[PoseScores, int]:
    """Scores of the frames that both files have.

    Args:
        true: TUM file of true cameras, ``world_from_camera``.
        predicted: TUM file of predicted ones, in any world and scale.
        gap: Frames between the cameras of a pair.
        close_s: Largest difference between the time stamps of one frame, in seconds.

    Returns:
        The scores, and how many frames of the truth have no prediction.

    Raises:
        ResultError: If a file cannot be read, time does not increase in it, or fewer than three frames are in both.
    """
    (true_s, true_poses), (predicted_s, predicted_poses) = (_read(path) for path in (true, predicted))
    mine, other = matched(true_s, predicted_s, close_s)
    if len(mine) < 3:
        raise ResultError(
            f"{true} and {predicted}: {len(mine)} time stamps lie within {close_s:g} s of each other, at least 3 are "
            "needed; are both in seconds, from the same start?"
        )
    poses = TruePoses(true_poses[mine], "of the file", None)
    scores = pose_scores(poses, predicted_poses[other], np.zeros(len(mine), np.int32), gap, None)
    assert scores is not None
    return scores, len(true_s) - len(mine)


def matched(a: F64, b: F64, close_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places of the time stamps of ``a`` that have one of ``b`` within ``close_s``, and of the nearest in ``b``.

    Both increase; no time stamp of ``b`` is used twice.
    """
    right = np.clip(np.searchsorted(b, a), 1, max(len(b) - 1, 1))
    nearest = np.where(np.abs(a - b[right - 1]) <= np.abs(b[np.minimum(right, len(b) - 1)] - a), right - 1, right)
    nearest = np.minimum(nearest, len(b) - 1)
    found, last = [], -1
    for place in np.flatnonzero(np.abs(a - b[nearest]) <= close_s):
        if nearest[place] > last:
            last = int(nearest[place])
            found.append(place)
    mine = np.array(found, np.intp)
    return mine, nearest[mine]


def _read(path: Path) -> tuple[F64, F64]:
    stamps, poses = read_tum(path)
    if len(stamps) == 0:
        raise ResultError(f"{path}: no cameras in it")
    if (np.diff(stamps) <= 0).any():
        raise ResultError(f"{path}: time stamps must increase from line to line")
    return stamps, poses

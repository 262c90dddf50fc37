"""Do poses and true depth agree, and which way round? Depth carried to another frame must meet the depth there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bathyscope.camera import F64, invert_pose, project, unproject
from bathyscope_train.evaluation.sequences import F32, MILLIMETRES, EvaluationSequence

_LEAST_PIXELS = 50
_TELLING = 0.02
"""Relative change of depth between two frames below which a direction cannot be told."""


@dataclass(frozen=True, slots=True)
class PoseAgreement:
    """Median relative difference of carried depth and depth that is there."""

    frames: tuple[int, int]
    as_read: float
    turned_round: float
    """With all poses inverted: what it would be if they were stored the other way round."""
    standing_still: float
    """If the camera had not moved."""

    @property
    def tells(self) -> bool:
        """Whether the camera moves enough between the two frames to tell."""
        return max(self.turned_round, self.standing_still) > _TELLING

    @property
    def wrong_way(self) -> bool:
        """Whether the poses look inverted."""
        return self.tells and self.turned_round < 0.5 * self.as_read

    def __str__(self) -> str:
        others = (self.turned_round, self.standing_still)
        turned, still = (f"{value:.1%}" if np.isfinite(value) else "out of the picture" for value in others)
        words = (
            f"depth carried from frame {self.frames[0]} to {self.frames[1]} differs by {self.as_read:.1%} "
            f"(poses turned round: {turned}, camera standing still: {still})"
        )
        return words if self.tells else f"{words}; too little motion to tell the direction"


def pose_agreement(sequence: EvaluationSequence, *, reach: int = 40) -> PoseAgreement | None:
    """Measure the first frame with depth against the one of the next ``reach`` whose camera is farthest from it.

    ``None`` where poses, depth or intrinsics are missing, or no pixel can be compared.

    Raises:
        DatasetError: If a depth file cannot be read.
    """
    pair = _pair(sequence, reach)
    if pair is None or sequence.intrinsics is None:
        return None
    (first, a), (second, b), factor = pair
    poses = sequence.world_from_camera
    assert poses is not None
    moved = np.array(poses[[first, second]])
    moved[:, :3, 3] *= factor
    depths = a, b
    variants = (moved, invert_pose(moved), np.tile(np.eye(4), (2, 1, 1)))
    found = [_difference(depths, sequence.intrinsics, variant) for variant in variants]
    if found[0] is None:
        return None
    return PoseAgreement((first, second), *(np.inf if value is None else value for value in found))


def _pair(sequence: EvaluationSequence, reach: int) -> tuple[tuple[int, F32], tuple[int, F32], float] | None:
    poses = sequence.world_from_camera
    if poses is None or sequence.pose_unit is None:
        return None
    known = [int(k) for k in np.flatnonzero(np.isfinite(poses).all((1, 2)))[: reach + 1]]
    first = next(((k, depth) for k in known if (depth := sequence.truth(k)) is not None and depth.any()), None)
    if first is None:
        return None
    distance = {k: float(np.linalg.norm(poses[k, :3, 3] - poses[first[0], :3, 3])) for k in known if k > first[0]}
    for k in sorted(distance, key=lambda k: -distance[k]):
        depth = sequence.truth(k)
        if depth is not None and depth.any():
            return first, (k, depth), _factor(sequence)
    return None


def _factor(sequence: EvaluationSequence) -> float:
    """Units of depth in one unit of the poses."""
    unit = sequence.pose_unit
    if unit is None or unit not in MILLIMETRES or sequence.depth_unit not in MILLIMETRES:
        return 1.0
    return MILLIMETRES[unit] / MILLIMETRES[sequence.depth_unit]


def _difference(depths: tuple[F32, F32], intrinsics: F64, world_from_camera: F64) -> float | None:
    """Median relative difference where depth of the first frame lands in the second; ``None`` if hardly any does."""
    source, target = depths
    height, width = source.shape
    step = max(1, int(np.sqrt(height * width / 40_000)))
    rows, columns = (part[::step, ::step] for part in np.mgrid[:height, :width])
    points = unproject(source, intrinsics, world_from_camera[0])[rows, columns]
    pixels, z = project(points, intrinsics, world_from_camera[1])
    ahead = (source[rows, columns] > 0) & (z > 0)
    u, v = (np.where(ahead, pixels[..., axis], -1.0) for axis in (0, 1))
    ahead &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = (np.where(ahead, place, 0).astype(np.intp) for place in (u, v))
    observed = target[v, u]
    ahead &= observed > 0
    if ahead.sum() < _LEAST_PIXELS:
        return None
    return float(np.median(np.abs(z[ahead] - observed[ahead]) / observed[ahead]))

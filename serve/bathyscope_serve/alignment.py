"""The similarity that carries one window's world into another's, from the frames that both have seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Similarity, matrix_to_quaternion, quaternion_to_matrix, rotation_angle
from bathyscope_serve.engine_settings import StitchSettings

F32 = NDArray[np.float32]
_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class SharedFrames:
    """s frames as one window has them."""

    depth: F32
    """(s, h, w)"""
    known: NDArray[np.bool_]
    """(s, h, w)"""
    world_from_camera: F64
    """(s, 4, 4)"""


@dataclass(frozen=True, slots=True)
class Misfit:
    """Why two windows could not be brought together."""

    reason: str


def align(target: SharedFrames, source: SharedFrames, settings: StitchSettings) -> Similarity | Misfit:
    """The similarity from the world of ``source`` to that of ``target``.

    The scale is the median ratio of the two depths over all shared pixels: thousands of values, where the
    baselines of an endoscope that hardly moves would give a handful of noisy ones. Rotation and translation are robust
    means over the shared cameras.
    """
    both = target.known & source.known
    measured = target.known.any(axis=(1, 2))  # the others hold cameras only
    share = float(both[measured].mean()) if measured.any() else 0.0
    if share < settings.least_share:
        return Misfit(f"only {share:.1%} of the shared pixels have depth in both windows")
    ratios = np.log(target.depth[both].astype(np.float64) / source.depth[both])
    middle = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios - middle)))
    if spread > settings.depth_spread:
        return Misfit(f"the depths of the shared frames differ by a factor of {np.exp(spread):.2f} beyond their scale")
    scale = float(np.exp(middle))
    turns = target.world_from_camera[:, :3, :3] @ np.swapaxes(source.world_from_camera[:, :3, :3], 1, 2)
    rotation = mean_rotation(turns)
    disagreement = float(np.degrees(np.median(rotation_angle(turns @ rotation.T))))
    if disagreement > settings.rotation_spread_deg:
        return Misfit(f"the shared cameras disagree by {disagreement:.0f} degrees")
    offsets = target.world_from_camera[:, :3, 3] - scale * source.world_from_camera[:, :3, 3] @ rotation.T
    return Similarity(scale, rotation, geometric_median(offsets))


def mean_rotation(rotations: F64) -> F64:
    """Robust mean (3, 3) of rotations (s, 3, 3): half of them may be off without moving it far."""
    weights = np.ones(len(rotations))
    mean = rotations[0]
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.tensordot(weights, rotations, 1))
        mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        weights = 1 / np.maximum(rotation_angle(rotations @ mean.T), 1e-4)
    return np.asarray(mean, np.float64)


def geometric_median(points: F64) -> F64:
    """The point (3,) of least total distance to points (s, 3), by Weiszfeld's iteration."""
    centre = np.median(points, axis=0)
    floor = 1e-6 * max(1e-12, float(np.abs(points - centre).max()))
    for _ in range(_ROUNDS):
        weights = 1 / np.maximum(np.linalg.norm(points - centre, axis=1), floor + 1e-12)
        centre = weights @ points / weights.sum()
    return np.asarray(centre, np.float64)


def blend_poses(first: F64, second: F64, share: float) -> F64:
    """Pose (4, 4) between two: rotation along the shortest arc, position along the line; share 0 is ``first``."""
    a, b = matrix_to_quaternion(first[:3, :3]), matrix_to_quaternion(second[:3, :3])
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        quaternion = (1 - share) * a + share * b
    else:
        quaternion = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(quaternion)
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return pose

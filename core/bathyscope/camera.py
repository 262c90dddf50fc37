"""Camera geometry in numpy: poses, intrinsics, quaternions, similarity transforms.

Conventions (``docs/conventions.md``): x right, y down, z forward; ``world_from_camera`` maps camera points to
the world; the centre of the first pixel is (0.5, 0.5); quaternions are (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError

F64 = NDArray[np.float64]
Size = tuple[int, int]
"""(height, width) in pixels."""


def invert_pose(pose: F64) -> F64:
    """Inverse of rigid transforms (..., 4, 4), in closed form."""
    rotation, translation = pose[..., :3, :3], pose[..., :3, 3]
    inverse = np.zeros(pose.shape, np.float64)
    transposed = np.swapaxes(rotation, -1, -2)
    inverse[..., :3, :3] = transposed
    inverse[..., :3, 3] = -(transposed @ translation[..., None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def rebase(world_from_camera: F64) -> F64:
    """Poses (t, 4, 4) in the world of the first camera: frame 0 becomes the identity exactly."""
    rebased = invert_pose(world_from_camera[0]) @ world_from_camera
    rebased[0] = np.eye(4)
    return np.asarray(rebased, np.float64)


def scale_intrinsics(intrinsics: F64, source: Size, target: Size) -> F64:
    """Intrinsics (..., 3, 3) of an image of ``source`` size for the same image resized to ``target``."""
    (source_h, source_w), (target_h, target_w) = source, target
    scale = np.diag([target_w / source_w, target_h / source_h, 1.0])
    return np.asarray(scale @ intrinsics, np.float64)


def crop_intrinsics(intrinsics: F64, left: float, top: float) -> F64:
    """Intrinsics (..., 3, 3) after cutting ``left`` columns and ``top`` rows away (negative: adding them)."""
    cropped = np.array(intrinsics, np.float64)
    cropped[..., 0, 2] -= left
    cropped[..., 1, 2] -= top
    return cropped


def pixel_grid(size: Size) -> F64:
    """(h, w, 2) pixel centres (u, v) in the half-pixel convention."""
    h, w = size
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    return np.stack([u, v], -1)


def unproject(depth: NDArray[np.floating], intrinsics: F64, world_from_camera: F64) -> F64:
    """World points (h, w, 3) of a z-depth map (h, w): the paper's Eq. 3."""
    return unproject_pixels(pixel_grid((depth.shape[0], depth.shape[1])), depth, intrinsics, world_from_camera)


def unproject_pixels(pixels: F64, depth: NDArray[np.floating], intrinsics: F64, world_from_camera: F64) -> F64:
    """World points (..., 3) of pixels (..., 2) with z-depths (...)."""
    x = (pixels[..., 0] - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (pixels[..., 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    points = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None].astype(np.float64)
    return np.asarray(points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3], np.float64)


def project(points: F64, intrinsics: F64, world_from_camera: F64) -> tuple[F64, F64]:
    """Pixels (..., 2) and z-depths (...) of world points (..., 3); pixels of points at z <= 0 are NaN."""
    camera = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    z = camera[..., 2]
    ahead = z > 0
    safe = np.where(ahead, z, 1.0)
    u = intrinsics[0, 0] * camera[..., 0] / safe + intrinsics[0, 2]
    v = intrinsics[1, 1] * camera[..., 1] / safe + intrinsics[1, 2]
    pixels = np.where(ahead[..., None], np.stack([u, v], -1), np.nan)
    return pixels, np.asarray(z, np.float64)


def quaternion_to_matrix(quaternions: NDArray[np.floating]) -> F64:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in the order (w, x, y, z), of any length but zero."""
    q = np.asarray(quaternions, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quaternion(rotations: NDArray[np.floating]) -> F64:
    """Unit quaternions (..., 4), (w, x, y, z) with w >= 0, of rotation matrices (..., 3, 3).

    Each row takes the branch that divides by the largest of the four components (Shepperd's method), so half
    turns are as exact as small ones.
    """
    r = np.asarray(rotations, np.float64)
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    squares = np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    s0, s1, s2, s3 = np.moveaxis(squares, -1, 0)
    branches = np.stack(
        [
            np.stack([s0, wx, wy, wz], -1),
            np.stack([wx, s1, xy, xz], -1),
            np.stack([wy, xy, s2, yz], -1),
            np.stack([wz, xz, yz, s3], -1),
        ],
        -2,
    )
    best = np.argmax(squares, -1)
    q = np.take_along_axis(branches, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., :1] < 0, -q, q), np.float64)


def rotation_angle(rotations: NDArray[np.floating]) -> F64:
    """Angles in radians, 0 to pi, of rotation matrices (..., 3, 3); accurate for small angles too."""
    r = np.asarray(rotations, np.float64)
    axis = np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]],
        -1,
    )
    sine = np.linalg.norm(axis, axis=-1)
    return np.asarray(np.arctan2(sine, np.trace(r, axis1=-2, axis2=-1) - 1.0), np.float64)


@dataclass(frozen=True, slots=True)
class Similarity:
    """x' = scale * rotation @ x + translation: how one world lies in another."""

    scale: float
    rotation: F64
    """(3, 3)"""
    translation: F64
    """(3,)"""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise GeometryError(f"a similarity needs a positive finite scale, got {self.scale}")

    @classmethod
    def identity(cls) -> Similarity:
        """The transform that changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    def points(self, points: F64) -> F64:
        """Points (..., 3) carried over."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation, np.float64)

    def poses(self, world_from_camera: F64) -> F64:
        """Poses (..., 4, 4) of the same cameras in the other world; rotations stay rotations."""
        moved = np.array(world_from_camera, np.float64)
        moved[..., :3, :3] = self.rotation @ world_from_camera[..., :3, :3]
        moved[..., :3, 3] = self.points(world_from_camera[..., :3, 3])
        return moved

    def __matmul__(self, other: Similarity) -> Similarity:
        """``self`` after ``other``."""
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, self.points(other.translation))

    def inverse(self) -> Similarity:
        """The way back."""
        back = self.rotation.T
        return Similarity(1.0 / self.scale, back, -(back @ self.translation) / self.scale)

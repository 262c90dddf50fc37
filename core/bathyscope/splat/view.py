"""One checked camera: the numbers the formulas use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import GeometryError

F64 = NDArray[np.float64]

LARGEST_SIDE = 32_768
"""Pixels; tile numbers of an image up to this size fit the 16 bits they are stored in."""

CLAMP_MARGIN = 0.15
"""How far outside the image, in image sizes, the slope of a ray may lie before the Jacobian sees it clamped."""


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera in float64; ``lower`` and ``upper`` bound the slopes (x/z, y/z) that the Jacobian sees."""

    rotation: F64
    translation: F64
    focal: F64
    """(2,) fx, fy in pixels."""
    principal: F64
    """(2,) cx, cy in pixels."""
    size: Size
    lower: F64
    upper: F64

    @property
    def centre(self) -> F64:
        """(3,) the camera in the world."""
        return -self.rotation.T @ self.translation


def make_view(camera_from_world: NDArray[np.floating[Any]], intrinsics: NDArray[np.floating[Any]], size: Size) -> View:
    """Check a camera.

    Args:
        camera_from_world: (4, 4) rigid transform.
        intrinsics: (3, 3) in pixels of ``size``; skew is not supported.
        size: (height, width).

    Raises:
        GeometryError: If a shape is wrong, a number is not finite, a focal length or a side is not positive.
    """
    pose = _matrix("camera_from_world", camera_from_world, 4)
    k = _matrix("intrinsics", intrinsics, 3)
    height, width = (int(side) for side in size)
    if not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
        raise GeometryError(f"an image size needs sides of 1 to {LARGEST_SIDE} px, got (height, width) = {size}")
    focal = np.array([k[0, 0], k[1, 1]])
    principal = np.array([k[0, 2], k[1, 2]])
    if not (focal > 0).all():
        raise GeometryError(f"focal lengths must be positive, got fx={focal[0]}, fy={focal[1]}")
    if k[0, 1] != 0 or k[1, 0] != 0:
        raise GeometryError(f"intrinsics with skew are not supported, got [0, 1] = {k[0, 1]}, [1, 0] = {k[1, 0]}")
    sides = np.array([width, height], np.float64)
    margin = CLAMP_MARGIN * sides / focal
    lower = -principal / focal - margin
    upper = (sides - principal) / focal + margin
    return View(pose[:3, :3], pose[:3, 3], focal, principal, (height, width), lower, upper)


def _matrix(name: str, value: NDArray[np.floating[Any]], side: int) -> F64:
    matrix = np.asarray(value, np.float64)
    if matrix.shape != (side, side):
        raise GeometryError(f"{name} must have shape ({side}, {side}), got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise GeometryError(f"{name} has values that are not finite")
    return matrix

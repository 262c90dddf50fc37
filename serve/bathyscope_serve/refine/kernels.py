"""Kernels of the bundle adjustment: sums over all sights of all points, by the formulas in :mod:`.adjustment`."""

from __future__ import annotations

from math import log, log1p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.splat.jit import inlined, kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

LOOSE = 4.0
"""Square of the distance, in pixels, at which a sight begins to count as wrong."""
NEAREST = 1e-9
_BEHIND = LOOSE * log1p(1e4 / LOOSE)
"""What a point behind a camera costs."""


@inlined
def _see(rotation: F64, translation: F64, point: F64, seen: F64) -> None:
    """The point (3,) in a camera."""
    for row in range(3):
        seen[row] = translation[row]
        for k in range(3):
            seen[row] += rotation[row, k] * point[k]


@inlined
def _residual(seen: F64, sight: F64, tolerance: float, residual: F64) -> None:
    """Two distances in pixels and one of log depth. ``sight``: ray x and y, focal length, log depth or NaN."""
    residual[0] = sight[2] * (seen[0] / seen[2] - sight[0])
    residual[1] = sight[2] * (seen[1] / seen[2] - sight[1])
    known = sight[3] == sight[3]
    residual[2] = (log(seen[2]) - sight[3]) / tolerance if known else 0.0


@kernel
def misfit(
    start: I64, camera: I64, sights: F64, rotation: F64, translation: F64, points: F64, tolerance: F64, work: F64
) -> Any:
    """Robust cost of a state; ``work`` (2, 3)."""
    seen, residual = work[0], work[1]
    cost = 0.0
    for p in range(len(points)):
        for i in range(start[p], start[p + 1]):
            c = camera[i]
            _see(rotation[c], translation[c], points[p], seen)
            if seen[2] <= NEAREST:
                cost += _BEHIND
                continue
            _residual(seen, sights[i], tolerance[i], residual)
            e = residual[0] * residual[0] + residual[1] * residual[1]
            cost += LOOSE * log1p(e / LOOSE) + log1p(residual[2] * residual[2])
    return cost


@inlined
def _jacobians(seen: F64, sight: F64, tolerance: float, rotation: F64, of_camera: F64, of_point: F64) -> None:
    """Derivatives (3, 6) by a turn and a shift of the camera, and (3, 3) by the point."""
    x, y, z, focal = seen[0], seen[1], seen[2], sight[2]
    for row in range(3):
        if row == 0:
            dx, dy, dz = focal / z, 0.0, -focal * x / (z * z)
        elif row == 1:
            dx, dy, dz = 0.0, focal / z, -focal * y / (z * z)
        else:
            dx, dy, dz = 0.0, 0.0, 1 / (z * tolerance) if sight[3] == sight[3] else 0.0
        of_camera[row, 0] = dz * y - dy * z
        of_camera[row, 1] = dx * z - dz * x
        of_camera[row, 2] = dy * x - dx * y
        of_camera[row, 3], of_camera[row, 4], of_camera[row, 5] = dx, dy, dz
        for k in range(3):
            of_point[row, k] = dx * rotation[0, k] + dy * rotation[1, k] + dz * rotation[2, k]


@inlined
def _invert(h: F64, inverse: F64) -> None:
    """Inverse of a symmetric (3, 3) matrix."""
    a = h[1, 1] * h[2, 2] - h[1, 2] * h[1, 2]
    b = h[0, 2] * h[1, 2] - h[0, 1] * h[2, 2]
    c = h[0, 1] * h[1, 2] - h[0, 2] * h[1, 1]
    over = 1 / (h[0, 0] * a + h[0, 1] * b + h[0, 2] * c)
    inverse[0, 0] = over * a
    inverse[0, 1] = inverse[1, 0] = over * b
    inverse[0, 2] = inverse[2, 0] = over * c
    inverse[1, 1] = over * (h[0, 0] * h[2, 2] - h[0, 2] * h[0, 2])
    inverse[1, 2] = inverse[2, 1] = over * (h[0, 1] * h[0, 2] - h[0, 0] * h[1, 2])
    inverse[2, 2] = over * (h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1])


@kernel
def normal_equations(
    start: I64,
    camera: I64,
    column: I64,
    sights: F64,
    rotation: F64,
    translation: F64,
    points: F64,
    tolerance: F64,
    damping: float,
    matrix: F64,
    right: F64,
    diagonal: F64,
    coupling: F64,
    inverse: F64,
    slope: F64,
    work: F64,
) -> None:
    """The equations of the free cameras after the points are eliminated (Schur complement).

    Args:
        start: (n + 1,) first sight of each point.
        camera: (m,) camera of each sight.
        column: (c,) place of a camera among the free ones, -1 if it is fixed.
        sights: (m, 4) ray x and y, focal length in pixels, logarithm of the depth or NaN.
        rotation: (c, 3, 3) camera from world.
        translation: (c, 3)
        points: (n, 3)
        tolerance: (m,) Standard deviations of the logarithm of depth.
        damping: Levenberg-Marquardt, relative to the diagonal.
        matrix: (6 f, 6 f) out.
        right: (6 f,) out: the gradient.
        diagonal: (6 f,) out: of the matrix before the points were eliminated.
        coupling: (m, 6, 3) out.
        inverse: (n, 3, 3) out.
        slope: (n, 3) out.
        work: (8, 6) scratch.
    """
    seen, residual = work[0, :3], work[1, :3]
    of_camera, of_point, h = work[2:5], work[5:8, :3], work[5:8, 3:]
    matrix[:] = 0
    right[:] = 0
    diagonal[:] = 0
    for p in range(len(points)):
        h[:] = 0
        slope[p] = 0
        for i in range(start[p], start[p + 1]):
            c = camera[i]
            coupling[i] = 0
            _see(rotation[c], translation[c], points[p], seen)
            if seen[2] <= NEAREST:
                continue
            _residual(seen, sights[i], tolerance[i], residual)
            _jacobians(seen, sights[i], tolerance[i], rotation[c], of_camera, of_point)
            weight = 1 / (1 + (residual[0] * residual[0] + residual[1] * residual[1]) / LOOSE)
            at = 6 * column[c]
            for row in range(3):
                w = weight if row < 2 else 1 / (1 + residual[2] * residual[2])
                for a in range(3):
                    slope[p, a] += w * of_point[row, a] * residual[row]
                    for b in range(3):
                        h[a, b] += w * of_point[row, a] * of_point[row, b]
                if at < 0:
                    continue
                for a in range(6):
                    right[at + a] += w * of_camera[row, a] * residual[row]
                    diagonal[at + a] += w * of_camera[row, a] * of_camera[row, a]
                    for b in range(6):
                        matrix[at + a, at + b] += w * of_camera[row, a] * of_camera[row, b]
                    for b in range(3):
                        coupling[i, a, b] += w * of_camera[row, a] * of_point[row, b]
        trace = h[0, 0] + h[1, 1] + h[2, 2]
        for a in range(3):
            h[a, a] += damping * h[a, a] + 1e-9 * trace + 1e-30
        _invert(h, inverse[p])
        _eliminate(start[p], start[p + 1], camera, column, coupling, inverse[p], slope[p], matrix, right, of_camera)
    for a in range(len(diagonal)):
        matrix[a, a] += damping * diagonal[a]


@inlined
def _eliminate(
    first: int,
    end: int,
    camera: I64,
    column: I64,
    coupling: F64,
    inverse: F64,
    slope: F64,
    matrix: F64,
    right: F64,
    work: F64,
) -> None:
    """Take one point out of the equations of the cameras that see it; ``work`` (3, 6)."""
    for i in range(first, end):
        at = 6 * column[camera[i]]
        if at < 0:
            continue
        for a in range(6):
            for b in range(3):
                work[b, a] = (
                    coupling[i, a, 0] * inverse[0, b]
                    + coupling[i, a, 1] * inverse[1, b]
                    + coupling[i, a, 2] * inverse[2, b]
                )
            right[at + a] -= work[0, a] * slope[0] + work[1, a] * slope[1] + work[2, a] * slope[2]
        for j in range(first, end):
            to = 6 * column[camera[j]]
            if to < 0:
                continue
            for a in range(6):
                for b in range(6):
                    matrix[at + a, to + b] -= (
                        work[0, a] * coupling[j, b, 0] + work[1, a] * coupling[j, b, 1] + work[2, a] * coupling[j, b, 2]
                    )


@kernel
def moved_points(
    start: I64,
    camera: I64,
    column: I64,
    coupling: F64,
    inverse: F64,
    slope: F64,
    step: F64,
    points: F64,
    moved: F64,
    work: F64,
) -> None:
    """Points (n, 3) after the cameras took a step (6 f,); ``work`` (3,)."""
    for p in range(len(points)):
        for a in range(3):
            work[a] = slope[p, a]
        for i in range(start[p], start[p + 1]):
            at = 6 * column[camera[i]]
            if at < 0:
                continue
            for a in range(3):
                for b in range(6):
                    work[a] += coupling[i, b, a] * step[at + b]
        for a in range(3):
            moved[p, a] = points[p, a] - (
                inverse[p, a, 0] * work[0] + inverse[p, a, 1] * work[1] + inverse[p, a, 2] * work[2]
            )

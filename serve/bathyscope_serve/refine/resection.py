"""A camera among points whose places are known."""

from __future__ import annotations

import numpy as np

from bathyscope.camera import F64
from bathyscope_serve.refine.adjustment import rotations
from bathyscope_serve.refine.kernels import LOOSE

LEAST_POINTS = 12
_ROUNDS = 6


def resect(camera_from_world: F64, points: F64, rays: F64, focal: F64) -> F64:
    """The camera (4, 4) that sees the points where they were seen, by robust Gauss-Newton from the one given.

    Args:
        camera_from_world: Where to begin; the answer if there are too few points.
        points: (n, 3)
        rays: (n, 2) x and y of the rays to them.
        focal: (n,) in pixels.
    """
    camera = camera_from_world
    if len(points) < LEAST_POINTS:
        return camera
    cost = _cost(camera, points, rays, focal)
    for _ in range(_ROUNDS):
        trial = _step(camera, points, rays, focal)
        trial_cost = _cost(trial, points, rays, focal)
        if not trial_cost < cost:
            break
        camera, cost = trial, trial_cost
    return camera


def _step(camera: F64, points: F64, rays: F64, focal: F64) -> F64:
    seen = points @ camera[:3, :3].T + camera[:3, 3]
    x, y, z = seen[:, 0], seen[:, 1], np.maximum(seen[:, 2], 1e-9)
    off = (focal[:, None] * (seen[:, :2] / z[:, None] - rays)).ravel()
    by_place = np.zeros((len(points), 2, 3))
    by_place[:, 0, 0] = by_place[:, 1, 1] = focal / z
    by_place[:, 0, 2], by_place[:, 1, 2] = -focal * x / z**2, -focal * y / z**2
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    slope = np.concatenate([by_place @ cross, by_place], 2).reshape(-1, 6)
    weight = np.repeat(1 / (1 + (off.reshape(-1, 2) ** 2).sum(1) / LOOSE), 2)
    square = slope.T @ (slope * weight[:, None])
    change = -np.linalg.solve(square + (1e-9 * np.trace(square) + 1e-12) * np.eye(6), slope.T @ (weight * off))
    turn = rotations(change[None, :3])[0]
    moved = np.eye(4)
    moved[:3, :3] = turn @ camera[:3, :3]
    moved[:3, 3] = turn @ camera[:3, 3] + change[3:]
    return moved


def _cost(camera: F64, points: F64, rays: F64, focal: F64) -> float:
    seen = points @ camera[:3, :3].T + camera[:3, 3]
    z = np.maximum(seen[:, 2], 1e-9)
    off = focal[:, None] * (seen[:, :2] / z[:, None] - rays)
    return float(np.log1p((off**2).sum(1) / LOOSE).sum())

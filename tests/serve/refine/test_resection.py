"""A camera among known points, against the camera that saw them."""

from __future__ import annotations

import numpy as np

from bathyscope.camera import F64, rotation_angle
from bathyscope_serve.refine.adjustment import rotations
from bathyscope_serve.refine.resection import LEAST_POINTS, resect


def seen_world(count: int) -> tuple[F64, F64, F64]:
    rng = np.random.default_rng(1)
    points = np.stack([*rng.uniform(-2, 2, (2, count)), rng.uniform(4, 9, count)], 1)
    camera = np.eye(4)
    camera[:3, :3] = rotations(np.array([[0.1, -0.2, 0.05]]))[0]
    camera[:3, 3] = 0.3, -0.1, 0.2
    seen = points @ camera[:3, :3].T + camera[:3, 3]
    return camera, points, seen[:, :2] / seen[:, 2:]


def test_the_camera_is_found_though_a_quarter_of_the_sights_is_wrong() -> None:
    camera, points, rays = seen_world(100)
    rays[::4] += 0.3
    start = camera.copy()
    start[:3, :3] = rotations(np.array([[0.02, 0.02, -0.02]]))[0] @ start[:3, :3]
    start[:3, 3] += 0.1
    for _ in range(3):
        start = resect(start, points, rays, np.full(100, 300.0))
    assert np.degrees(rotation_angle((start[:3, :3] @ camera[:3, :3].T)[None])[0]) < 0.05
    np.testing.assert_allclose(start[:3, 3], camera[:3, 3], atol=5e-3)


def test_a_handful_of_points_moves_nothing() -> None:
    _, points, rays = seen_world(LEAST_POINTS - 1)
    found = resect(np.eye(4), points, rays, np.full(len(points), 300.0))
    np.testing.assert_array_equal(found, np.eye(4))

"""Temporal errors on a plane that the camera approaches, flicker, and snippets."""

from __future__ import annotations

import numpy as np
import pytest

from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.flicker import flicker
from bathyscope_train.evaluation.snippets import chained, relative_poses, snippet_errors
from bathyscope_train.evaluation.temporal import (
    ENDODAV_WARPING,
    VDA_WARPING,
    View,
    Warping,
    fixed_intrinsics,
    temporal_error,
    warp,
)

SIZE = (16, 20)
K = np.array([[30.0, 0, 10], [0, 30.0, 8], [0, 0, 1]])


def plane(distance: float, moved: float, mask: np.ndarray | None = None) -> View:
    """A wall facing the camera, ``distance`` from where it started, after moving ``moved`` towards it."""
    camera_from_world = np.eye(4)
    camera_from_world[2, 3] = -moved
    keep = np.ones(SIZE, np.bool_) if mask is None else mask
    return View(np.full(SIZE, distance - moved), keep, camera_from_world, K)


@pytest.mark.parametrize("warping", [Warping(), ENDODAV_WARPING, VDA_WARPING], ids=["own", "endodav", "vda"])
def test_a_wall_that_comes_nearer_as_the_poses_say_costs_nothing(warping: Warping) -> None:
    found = temporal_error(plane(50, 0), plane(50, 5), warping)
    assert (found.tae, found.tas) == (pytest.approx(0, abs=1e-9), 1.0)


def test_a_prediction_that_jumps_costs_its_jump() -> None:
    """The second frame says 10 % too much: it is 1 - 1/1.1 off seen from it, and 10 % off seen from the first."""
    jumped = View(1.1 * plane(50, 5).depth, np.ones(SIZE, np.bool_), plane(50, 5).camera_from_world, K)
    found = temporal_error(plane(50, 0), jumped)
    forward, backward = 1 - 1 / 1.1, (1.1 * 45 + 5) / 50 - 1
    assert found.tae == pytest.approx(100 * (forward + backward) / 2)


def test_a_frame_without_pixels_has_no_error() -> None:
    found = temporal_error(plane(50, 0), plane(50, 5, np.zeros(SIZE, np.bool_)))
    assert np.isnan([found.tae, found.tas]).all()


def test_points_land_in_the_pixel_they_fall_into() -> None:
    """A camera that moves sideways by one pixel's width shifts the picture by one pixel."""
    source = plane(30, 0)
    moved = np.eye(4)
    moved[0, 3] = 1.0  # 30 px focal length, depth 30: one pixel
    source.depth[:, 4] = 29.0
    landed = warp(source, View(source.depth, source.mask, moved, K))
    assert np.flatnonzero(landed[0] == 29.0).tolist() == [5]
    assert np.flatnonzero(landed[0] == 0.0).tolist() == [0]


def test_the_nearest_of_several_points_wins_unless_told_otherwise() -> None:
    """Looked at from far away all points share one pixel."""
    source = View(np.array([[10.0, 20.0]]), np.ones((1, 2), np.bool_), np.eye(4), np.diag([1.0, 1, 1]))
    far = np.eye(4)
    far[2, 3] = 1000.0
    target = View(source.depth, source.mask, far, source.intrinsics)
    assert warp(source, target)[0, 0] == 1010.0
    assert warp(source, target, Warping(nearest_wins=False))[0, 0] == 1020.0


def test_the_fixed_camera_is_the_published_one_at_full_size() -> None:
    k = fixed_intrinsics((1024, 1280))
    assert (k[0, 0], k[1, 1], k[0, 2], k[1, 2]) == pytest.approx((1049.6, 1044.48, 640, 512))


def test_depth_that_grows_by_a_constant_factor_does_not_flicker() -> None:
    depth = np.random.default_rng(0).uniform(1, 9, SIZE)
    everywhere = np.ones(SIZE, np.bool_)
    assert flicker(depth, 1.1 * depth, 1.21 * depth, everywhere) == pytest.approx(0, abs=1e-10)
    assert flicker(depth, 1.1 * depth, depth, everywhere) == pytest.approx(200 * np.log(1.1))
    assert np.isnan(flicker(depth, depth, depth, ~everywhere))


def motion(step: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = step
    return pose


def test_relative_poses_chained_give_the_trajectory_back() -> None:
    poses = np.stack([motion((0.5 * t, 0, t * t)) for t in range(6)])
    assert chained(relative_poses(poses))[:, :3, 3] == pytest.approx(poses[:, :3, 3], abs=1e-5)


def test_a_snippet_that_is_right_up_to_scale_has_no_error() -> None:
    steps = np.stack([motion((0.5, 0.1 * t, 1)) for t in range(7)])
    halved = steps.copy()
    halved[:, :3, 3] /= 2
    found = snippet_errors(steps, halved)
    assert len(found.ate) == 6
    assert found.ate == pytest.approx(0, abs=1e-12)


def test_the_error_of_a_snippet_is_that_worked_out_by_hand() -> None:
    """Two steps of 1 along x; the second prediction stands still: scale 3/2, rests -0.5, 0.5, over 3 positions."""
    true = np.stack([motion((1, 0, 0)), motion((1, 0, 0))])
    predicted = np.stack([motion((1, 0, 0)), motion((0, 0, 0))])
    assert snippet_errors(true, predicted).ate == pytest.approx([np.sqrt(0.5) / 3])


def test_snippets_need_two_pairs_of_frames() -> None:
    with pytest.raises(GeometryError, match="at least two"):
        snippet_errors(np.eye(4)[None], np.eye(4)[None])

"""Trajectory errors, against scipy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bathyscope.camera import F64, Similarity
from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.alignment import align_positions
from bathyscope_train.evaluation.trajectory import (
    frame_pairs,
    relative_motion,
    relative_pose_errors,
    trajectory_errors,
)


def wandering_camera(frames: int, seed: int) -> F64:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, (frames, 3))).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(0, 1, (frames, 3)), axis=0)
    return poses


def some_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(float(rng.uniform(0.1, 10)), Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 5, 3))


def moving(frames: int, step: tuple[float, float, float], turn_deg: tuple[float, float, float] = (0, 0, 0)) -> F64:
    """Each frame is the one before, moved and turned by the same amount in its own axes."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    change[:3, 3] = step
    return np.stack([np.linalg.matrix_power(change, t) for t in range(frames)])


def all_pairs(frames: int, gap: int) -> np.ndarray:
    return frame_pairs(np.ones(frames, np.bool_), np.zeros(frames, np.int32), gap)


@pytest.mark.parametrize("seed", range(4))
def test_alignment_finds_the_similarity_between_two_worlds(seed: int) -> None:
    points, there = np.random.default_rng(seed).normal(0, 3, (12, 3)), some_similarity(seed)
    found = align_positions(points, there.points(points))
    assert found.scale == pytest.approx(there.scale)
    np.testing.assert_allclose(found.rotation, there.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, there.translation, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_alignment_of_noisy_points_agrees_with_scipys_rotation_and_the_best_scale_for_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(0, 3, (20, 3))
    target = some_similarity(seed).points(source) + rng.normal(0, 1, (20, 3))
    x, y = source - source.mean(axis=0), target - target.mean(axis=0)
    rotation, _ = Rotation.align_vectors(y, x)
    turned = rotation.apply(x)
    found = align_positions(source, target)
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-6)
    assert found.scale == pytest.approx((turned * y).sum() / (turned**2).sum())


def test_a_mirrored_world_is_not_matched_by_a_reflection() -> None:
    source = np.random.default_rng(0).normal(0, 1, (10, 3))
    found = align_positions(source, source * (1, 1, -1))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_alignment_of_a_straight_path_is_exact() -> None:
    source = np.outer(np.arange(5.0), [0, 0, 1])
    there = some_similarity(3)
    np.testing.assert_allclose(align_positions(source, there.points(source)).points(source), there.points(source))


@pytest.mark.parametrize(("source", "what"), [(np.ones((5, 3)), "same point"), (np.ones((2, 3)), "n >= 3")])
def test_positions_that_fix_no_similarity_are_refused(source: F64, what: str) -> None:
    with pytest.raises(GeometryError, match=what):
        align_positions(source, np.random.default_rng(0).normal(size=source.shape))


@pytest.mark.parametrize("seed", range(3))
def test_a_trajectory_seen_from_another_world_has_no_error(seed: int) -> None:
    true, there = wandering_camera(9, seed), some_similarity(seed + 10)
    errors = trajectory_errors(true, there.inverse().poses(true))
    assert errors.ate_rmse == pytest.approx(0.0, abs=1e-9)
    assert errors.scale == pytest.approx(there.scale)


def test_the_trajectory_error_is_the_smallest_that_any_similarity_reaches() -> None:
    true, predicted = wandering_camera(12, 1), wandering_camera(12, 1)
    predicted[:, :3, 3] += np.random.default_rng(5).normal(0, 0.8, (12, 3))

    def residuals(x: F64) -> F64:
        aligned = np.exp(x[0]) * Rotation.from_rotvec(x[1:4]).apply(predicted[:, :3, 3]) + x[4:]
        return (true[:, :3, 3] - aligned).ravel()

    best = least_squares(residuals, np.zeros(7), xtol=1e-12, ftol=1e-12)
    assert trajectory_errors(true, predicted).ate_rmse == pytest.approx(np.sqrt(2 * best.cost / 12), rel=1e-6)


def test_a_camera_predicted_to_stand_still_has_the_spread_of_the_true_path() -> None:
    true = moving(5, (0, 0, 2))
    still = np.tile(np.eye(4), (5, 1, 1))
    errors = trajectory_errors(true, still)
    assert errors.ate_rmse == errors.standing_still == pytest.approx(2 * np.sqrt(2))
    assert errors.scale == 0.0


def test_a_camera_that_truly_stands_still_has_no_trajectory_error() -> None:
    assert trajectory_errors(np.tile(np.eye(4), (4, 1, 1)), moving(4, (1, 0, 0))).ate_rmse == 0.0


def test_two_poses_are_too_few_for_a_trajectory_error() -> None:
    with pytest.raises(GeometryError, match="at least 3"):
        trajectory_errors(moving(2, (0, 0, 1)), moving(2, (0, 0, 1)))


@pytest.mark.parametrize("gap", [1, 3])
def test_rotation_error_over_a_gap_is_the_drift_collected_in_it(gap: int) -> None:
    true, predicted = moving(8, (0, 0, 1)), moving(8, (0, 0, 1), (0, 2, 0))
    errors = relative_motion(true, predicted, all_pairs(8, gap))
    np.testing.assert_allclose(errors.rotation_error_deg, 2 * gap, atol=1e-9)
    np.testing.assert_allclose(errors.true_rotation_deg, 0, atol=1e-9)
    np.testing.assert_allclose(errors.true_translation, gap)


def test_relative_errors_do_not_see_which_world_and_scale_the_prediction_is_in() -> None:
    true = wandering_camera(10, 2)
    errors = relative_motion(true, some_similarity(4).poses(true), all_pairs(10, 2))
    np.testing.assert_allclose(errors.rotation_error_deg, 0, atol=1e-5)
    np.testing.assert_allclose(errors.direction_cosine, 1)


@pytest.mark.parametrize(
    ("step", "cosine"), [((0, 0, 3), 1.0), ((0, 0, -1), -1.0), ((1, 0, 0), 0.0), ((1, 0, 1), 2**-0.5), ((0, 0, 0), 0.0)]
)
def test_direction_cosine_of_known_motions(step: tuple[float, float, float], cosine: float) -> None:
    errors = relative_motion(moving(4, (0, 0, 1)), moving(4, step), all_pairs(4, 1))
    np.testing.assert_allclose(errors.direction_cosine, cosine, atol=1e-12)


def test_a_pause_has_no_direction() -> None:
    true = moving(4, (0, 0, 1))
    true[2] = true[1]
    cosine = relative_motion(true, moving(4, (0, 0, 1)), all_pairs(4, 1)).direction_cosine
    np.testing.assert_array_equal(np.isnan(cosine), [False, True, False])


def test_relative_pose_error_of_known_motions() -> None:
    true, predicted = moving(6, (0, 0, 1)), moving(6, (0.5, 0, 0))
    translation, rotation = relative_pose_errors(true, predicted, all_pairs(6, 1), scale=2.0)
    assert translation == pytest.approx(np.sqrt(2))
    assert rotation == pytest.approx(0.0, abs=1e-9)
    _, rotation = relative_pose_errors(true, moving(6, (0, 0, 1), (0, 0, 3)), all_pairs(6, 2), scale=1.0)
    assert rotation == pytest.approx(6.0)


def test_pairs_lie_within_one_segment_and_have_both_poses() -> None:
    usable = np.array([True, True, False, True, True, True, True])
    segment = np.array([0, 0, 0, 0, 0, 1, 1])
    assert frame_pairs(usable, segment, 1).tolist() == [[0, 1], [3, 4], [5, 6]]
    assert frame_pairs(usable, segment, 3).tolist() == [[0, 3], [1, 4]]
    assert frame_pairs(usable, segment, 9).shape == (0, 2)


def test_a_gap_of_nothing_is_refused() -> None:
    with pytest.raises(GeometryError, match=r"at least 1 .*got 0"):
        frame_pairs(np.ones(3, np.bool_), np.zeros(3, np.int32), 0)

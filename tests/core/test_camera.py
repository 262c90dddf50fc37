"""Camera geometry, against scipy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from bathyscope.camera import (
    F64,
    Similarity,
    crop_intrinsics,
    invert_pose,
    matrix_to_quaternion,
    pixel_grid,
    project,
    quaternion_to_matrix,
    rebase,
    rotation_angle,
    scale_intrinsics,
    unproject,
)
from bathyscope.errors import GeometryError

K = np.array([[50.0, 0, 31.0], [0, 55.0, 22.0], [0, 0, 1]])
ANGLES = hnp.arrays(np.float64, 3, elements=st.floats(-10, 10))


def random_poses(count: int, seed: int = 0) -> F64:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 3, (count, 3))
    return poses


def half_turns() -> F64:
    """Half turns about every axis and edge: the hard cases of a matrix's quaternion."""
    axes = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    return np.asarray(Rotation.from_rotvec(math.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_matrix())


def test_inverse_poses_are_those_of_the_general_inverse() -> None:
    poses = random_poses(20).reshape(4, 5, 4, 4)
    np.testing.assert_allclose(invert_pose(poses), np.linalg.inv(poses), atol=1e-12)


def test_rebasing_makes_frame_0_exactly_the_identity_and_keeps_relative_motion() -> None:
    poses = random_poses(6)
    rebased = rebase(poses)
    np.testing.assert_array_equal(rebased[0], np.eye(4))
    for t in range(6):
        np.testing.assert_allclose(rebased[t], np.linalg.inv(poses[0]) @ poses[t], atol=1e-12)


@given(ANGLES)
def test_quaternions_are_scipys_in_the_order_w_x_y_z(rotation_vector: F64) -> None:
    rotation = Rotation.from_rotvec(rotation_vector)
    quaternion = matrix_to_quaternion(rotation.as_matrix())
    np.testing.assert_allclose(quaternion, rotation.as_quat(canonical=True, scalar_first=True), atol=1e-9)
    np.testing.assert_allclose(quaternion_to_matrix(quaternion), rotation.as_matrix(), atol=1e-12)


def test_half_turns_keep_full_precision() -> None:
    matrices = half_turns()
    quaternions = matrix_to_quaternion(matrices)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1.0, atol=1e-15)
    np.testing.assert_allclose(quaternion_to_matrix(quaternions), matrices, atol=1e-14)


@given(hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: float(np.linalg.norm(q)) > 1e-3))
def test_the_length_and_sign_of_a_quaternion_do_not_matter(quaternion: F64) -> None:
    matrix = quaternion_to_matrix(quaternion)
    np.testing.assert_allclose(matrix, quaternion_to_matrix(-3 * quaternion), atol=1e-12)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_quaternions_keep_leading_axes_and_w_is_not_negative() -> None:
    matrices = Rotation.random(24, random_state=1).as_matrix().reshape(2, 3, 4, 3, 3)
    quaternions = matrix_to_quaternion(matrices)
    assert quaternions.shape == (2, 3, 4, 4)
    assert (quaternions[..., 0] >= 0).all()


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 1.0, 90.0, 179.999, 180.0])
def test_rotation_angles_are_exact_from_tiny_to_half_a_turn(degrees: float) -> None:
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    matrix = Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix()
    assert math.degrees(float(rotation_angle(matrix))) == pytest.approx(degrees, abs=1e-9, rel=1e-6)


def test_pixel_centres_are_at_one_half() -> None:
    grid = pixel_grid((2, 3))
    assert grid.shape == (2, 3, 2)
    assert grid[0, 0].tolist() == [0.5, 0.5]
    assert grid[1, 2].tolist() == [2.5, 1.5]


def test_the_principal_ray_meets_a_plane_straight_ahead() -> None:
    """A camera 3 to the right that looks along its own z sees a plane at z = 4 there."""
    pose = np.eye(4)
    pose[:3, 3] = (3.0, 0.0, 0.0)
    camera = np.array([[10.0, 0, 1.5], [0, 10.0, 0.5], [0, 0, 1]])
    points = unproject(np.full((1, 3), 4.0), camera, pose)
    np.testing.assert_allclose(points[0], [[3 - 0.4, 0, 4], [3, 0, 4], [3 + 0.4, 0, 4]])


def test_y_points_down_and_x_to_the_right() -> None:
    pixels, z = project(np.array([[1.0, 0, 10], [0, 1.0, 10]]), K, np.eye(4))
    np.testing.assert_allclose(pixels, [[31 + 5, 22], [31, 22 + 5.5]])
    np.testing.assert_allclose(z, 10)


@given(st.integers(0, 1000), hnp.arrays(np.float64, (5, 7), elements=st.floats(0.1, 100)))
def test_projecting_what_was_unprojected_gives_the_pixels_back(seed: int, depth: F64) -> None:
    pose = random_poses(1, seed)[0]
    pixels, z = project(unproject(depth, K, pose), K, pose)
    np.testing.assert_allclose(pixels, pixel_grid((5, 7)), atol=1e-6)
    np.testing.assert_allclose(z, depth, rtol=1e-9)


def test_points_beside_or_behind_the_camera_have_no_pixel() -> None:
    pixels, z = project(np.array([[0, 0, -1.0], [1, 0, 0], [0, 0, 1e-3]]), K, np.eye(4))
    np.testing.assert_array_equal(np.isnan(pixels).all(axis=-1), [True, True, False])
    assert z.tolist() == [-1.0, 0.0, 1e-3]


def test_resizing_moves_the_projection_with_the_pixels() -> None:
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 5), (10, 3))
    small = scale_intrinsics(K, (44, 62), (11, 31))
    pixels, _ = project(points, K, np.eye(4))
    resized, _ = project(points, small, np.eye(4))
    np.testing.assert_allclose(resized, pixels * (31 / 62, 11 / 44))
    np.testing.assert_allclose(scale_intrinsics(small, (11, 31), (44, 62)), K)


def test_cropping_moves_the_projection_by_what_was_cut_and_leaves_the_input_alone() -> None:
    before = K.copy()
    stack = np.stack([K, K])
    cropped = crop_intrinsics(stack, left=7, top=-3)
    np.testing.assert_allclose(cropped[1, :2, 2], [31 - 7, 22 + 3])
    np.testing.assert_array_equal(stack[0], before)


def some_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(float(rng.uniform(0.1, 9)), Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 5, 3))


@pytest.mark.parametrize("seed", range(3))
def test_similarities_compose_and_invert_like_4x4_matrices(seed: int) -> None:
    def matrix(similarity: Similarity) -> F64:
        m = np.eye(4)
        m[:3, :3] = similarity.scale * similarity.rotation
        m[:3, 3] = similarity.translation
        return m

    a, b = some_similarity(seed), some_similarity(seed + 10)
    np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-9)
    np.testing.assert_allclose(matrix(a.inverse()), np.linalg.inv(matrix(a)), atol=1e-9)
    np.testing.assert_allclose(matrix(a @ Similarity.identity()), matrix(a), atol=1e-12)


def test_a_camera_moved_with_its_points_sees_them_at_the_same_pixels_and_scaled_depth() -> None:
    there, pose = some_similarity(5), random_poses(1, 2)[0]
    points = unproject(np.random.default_rng(1).uniform(1, 4, (4, 6)), K, pose)
    moved = there.poses(pose)
    pixels, z = project(there.points(points), K, moved)
    np.testing.assert_allclose(pixels, pixel_grid((4, 6)), atol=1e-6)
    np.testing.assert_allclose(z, there.scale * project(points, K, pose)[1])
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_similarity_without_a_positive_finite_scale_is_refused(scale: float) -> None:
    with pytest.raises(GeometryError, match="positive finite scale"):
        Similarity(scale, np.eye(3), np.zeros(3))

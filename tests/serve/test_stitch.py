"""Alignment and blending of windows, against transforms that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bathyscope.camera import F64, Similarity, quaternion_to_matrix, rotation_angle
from bathyscope_serve.alignment import Misfit, SharedFrames, align, blend_poses, geometric_median, mean_rotation
from bathyscope_serve.engine_settings import StitchSettings
from bathyscope_serve.placed import PlacedFrame
from bathyscope_serve.stitch import Stitcher, blend

SETTINGS = StitchSettings()


def random_rotation(rng: np.random.Generator, spread: float = 1.0) -> F64:
    return quaternion_to_matrix(np.concatenate([[1.0], spread * rng.normal(size=3)]))


def random_frames(rng: np.random.Generator, count: int = 5) -> SharedFrames:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.stack([random_rotation(rng) for _ in range(count)])
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    depth = rng.uniform(1, 4, (count, 8, 9)).astype(np.float32)
    return SharedFrames(depth, np.ones(depth.shape, np.bool_), poses)


def carried(frames: SharedFrames, motion: Similarity) -> SharedFrames:
    """The same frames as a window in another world has them."""
    depth = (frames.depth * motion.scale).astype(np.float32)
    return replace(frames, depth=depth, world_from_camera=motion.poses(frames.world_from_camera))


def assert_same(found: Similarity | Misfit, expected: Similarity, tolerance: float = 1e-5) -> None:
    assert isinstance(found, Similarity)
    assert found.scale == pytest.approx(expected.scale, rel=tolerance)
    assert rotation_angle(found.rotation @ expected.rotation.T) < tolerance
    np.testing.assert_allclose(found.translation, expected.translation, atol=10 * tolerance)


@pytest.mark.parametrize("seed", range(5))
def test_the_similarity_between_two_worlds_is_found_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Similarity(float(rng.uniform(0.2, 5)), random_rotation(rng), rng.normal(size=3))
    source = random_frames(rng)
    assert_same(align(carried(source, truth), source, SETTINGS), truth)


def test_a_wild_camera_and_a_third_of_wrong_pixels_do_not_move_it_far() -> None:
    rng = np.random.default_rng(7)
    truth = Similarity(1.7, random_rotation(rng), rng.normal(size=3))
    source = random_frames(rng, 7)
    target = carried(source, truth)
    target.world_from_camera[2, :3, :3] = random_rotation(rng, 5.0)
    target.world_from_camera[4, :3, 3] += 10
    wrong = rng.uniform(size=target.depth.shape) < 1 / 3
    target = replace(target, depth=np.where(wrong, target.depth * rng.uniform(0.2, 9, wrong.shape), target.depth))
    found = align(target, source, SETTINGS)
    assert isinstance(found, Similarity)
    assert found.scale == pytest.approx(1.7, rel=0.02)
    assert np.degrees(rotation_angle(found.rotation @ truth.rotation.T)) < 1
    np.testing.assert_allclose(found.translation, truth.translation, atol=0.05)


def test_cameras_that_disagree_are_no_alignment() -> None:
    rng = np.random.default_rng(1)
    found = align(random_frames(rng), random_frames(rng), StitchSettings(depth_spread=10))
    assert isinstance(found, Misfit)
    assert "degrees" in found.reason


def test_depths_that_disagree_are_no_alignment() -> None:
    rng = np.random.default_rng(1)
    source = random_frames(rng)
    target = replace(source, depth=np.exp(rng.normal(0, 2, source.depth.shape)).astype(np.float32))
    found = align(target, source, SETTINGS)
    assert isinstance(found, Misfit)
    assert "depths" in found.reason


def test_frames_without_common_pixels_are_no_alignment() -> None:
    source = random_frames(np.random.default_rng(1))
    empty = replace(source, known=np.zeros_like(source.known))
    assert isinstance(align(empty, source, SETTINGS), Misfit)


def test_frames_that_hold_cameras_only_do_not_lower_the_share_of_pixels_with_depth() -> None:
    """7 % of the pixels of two frames: enough for a scale, however many cameras stand beside them."""
    rng = np.random.default_rng(4)
    source = random_frames(rng, 8)
    known = np.zeros_like(source.known)
    known[:2, 0, :5] = True
    truth = Similarity(2.0, random_rotation(rng), rng.normal(size=3))
    assert_same(align(replace(carried(source, truth), known=known), source, SETTINGS), truth)


def test_half_way_between_two_poses_is_half_the_turn_and_half_the_way() -> None:
    rng = np.random.default_rng(2)
    first, second = np.eye(4), np.eye(4)
    first[:3, :3] = random_rotation(rng)
    second[:3, :3], second[:3, 3] = random_rotation(rng), [2, 4, 6]
    middle = blend_poses(first, second, 0.5)
    whole = rotation_angle(second[:3, :3] @ first[:3, :3].T)
    assert rotation_angle(middle[:3, :3] @ first[:3, :3].T) == pytest.approx(whole / 2, abs=1e-9)
    assert rotation_angle(second[:3, :3] @ middle[:3, :3].T) == pytest.approx(whole / 2, abs=1e-9)
    np.testing.assert_allclose(middle[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(blend_poses(first, second, 0.0), first, atol=1e-12)
    np.testing.assert_allclose(blend_poses(first, second, 1.0), second, atol=1e-12)


def test_robust_means_ignore_one_of_five() -> None:
    rng = np.random.default_rng(3)
    truth = random_rotation(rng)
    rotations = np.stack([truth] * 4 + [random_rotation(rng, 3.0)])
    assert rotation_angle(mean_rotation(rotations) @ truth.T) < 1e-3
    points = np.array([[1.0, 2, 3]] * 4 + [[50.0, 0, 0]])
    np.testing.assert_allclose(geometric_median(points), [1, 2, 3], atol=1e-3)


def frame(index: int, depth: float, *, known: bool = True, x: float = 0.0) -> PlacedFrame:
    pose = np.eye(4)
    pose[0, 3] = x
    shape = (4, 5)
    return PlacedFrame(
        index=index,
        timestamp_s=index / 25,
        depth=np.full(shape, depth, np.float32),
        confidence=np.full(shape, depth, np.float32),
        known=np.full(shape, known),
        world_from_camera=pose,
        intrinsics=np.eye(3),
    )


def test_a_blend_is_weighted_where_both_know_and_takes_who_knows_elsewhere() -> None:
    first, second = frame(0, 1.0), frame(0, 3.0)
    first.known[0], second.known[1] = False, False
    mixed = blend(first, second, 0.25)
    np.testing.assert_allclose(mixed.depth[0], 3.0)
    np.testing.assert_allclose(mixed.depth[1], 1.0)
    np.testing.assert_allclose(mixed.depth[2:], 1.5)


def test_the_overlap_goes_over_from_one_window_to_the_next_without_a_jump() -> None:
    """Window 2 sees twice the scale and, after alignment, a depth that is 10 % larger away from the overlap."""
    stitcher = Stitcher(SETTINGS)
    stitcher.add([frame(i, 1.0, x=0.1 * i) for i in range(6)])
    out = stitcher.take(3)
    assert [item.index for item in out] == [0, 1, 2]
    second = [frame(i, 2.0, x=0.2 * (i - 3)) for i in range(3, 6)] + [frame(i, 2.2, x=0.2 * (i - 3)) for i in (6, 7, 8)]
    stitcher.add(second)
    out += stitcher.take()
    assert [item.index for item in out] == list(range(9))
    np.testing.assert_allclose([item.depth[0, 0] for item in out], [1] * 6 + [1.1] * 3, rtol=1e-5)
    np.testing.assert_allclose([item.world_from_camera[0, 3] for item in out], 0.1 * np.arange(9), atol=1e-5)
    assert {item.segment for item in out} == {0}


def window_of(places: tuple[int, ...], scale: float) -> list[PlacedFrame]:
    """A camera that moves by 0.1 a frame before a wall at 1, in a world of another scale."""
    return [frame(place, scale, x=scale * 0.1 * (place - places[0])) for place in places]


def test_woven_windows_lie_in_one_world_whatever_their_scales() -> None:
    stitcher = Stitcher(SETTINGS)
    assert stitcher.weave([window_of((0, 3, 6), 1.0), window_of((0, 1, 4, 6), 3.0), window_of((0, 2, 5, 6), 0.2)])
    out = stitcher.take(3)
    assert stitcher.weave([window_of((3, 6, 9), 7.0), window_of((6, 7, 8, 9), 0.5)])
    out += stitcher.take()
    assert [item.index for item in out] == list(range(10))
    np.testing.assert_allclose([item.depth[0, 0] for item in out], 1.0, rtol=1e-5)
    np.testing.assert_allclose([item.world_from_camera[0, 3] for item in out], 0.1 * np.arange(10), atol=1e-5)


def test_a_window_whose_ends_disagree_is_held_by_where_its_other_cameras_are_expected() -> None:
    """The second window is turned by a tenth of a radian at one of its two ties only."""
    turn = quaternion_to_matrix(np.array([np.cos(0.05), 0.0, 0.0, np.sin(0.05)]))
    second = window_of((0, 1, 2, 4, 5, 6), 1.0)
    second[0].world_from_camera[:3, :3] = turn
    stitcher = Stitcher(SETTINGS)
    assert stitcher.weave([window_of((0, 3, 6), 1.0), second])
    for item in stitcher.take():
        assert rotation_angle(item.world_from_camera[:3, :3]) < 0.01


def test_windows_that_do_not_fit_together_leave_no_trace() -> None:
    stitcher = Stitcher(SETTINGS)
    stitcher.add(window_of((0, 1, 2), 1.0))
    wrong = window_of((1, 3, 5), 1.0)
    wrong[0].world_from_camera[:3, :3] = np.diag([-1.0, 1, -1])
    wrong[2].world_from_camera[:3, :3] = np.diag([1.0, -1, -1])
    assert not stitcher.weave([window_of((1, 2, 5), 1.0), wrong])
    assert [item.index for item in stitcher.take()] == [0, 1, 2]
    assert stitcher.warnings == []


def test_a_failed_alignment_begins_a_segment_and_says_so() -> None:
    stitcher = Stitcher(SETTINGS)
    stitcher.add([frame(i, 1.0) for i in range(4)])
    out = stitcher.take(2)
    turned = [frame(i, 1.0, x=5.0 + i) for i in range(2, 6)]
    turned[1].world_from_camera[:3, :3] = np.diag([-1.0, 1, -1])
    stitcher.add(turned)
    out += stitcher.take()
    assert [item.index for item in out] == list(range(6))
    assert [item.segment for item in out] == [0, 0, 0, 0, 1, 1]
    np.testing.assert_array_equal(out[4].world_from_camera, np.eye(4))
    np.testing.assert_allclose(out[5].world_from_camera[0, 3], 1.0)
    assert "frames from 4 on" in stitcher.warnings[0]


def test_a_cut_begins_a_segment_and_says_so() -> None:
    stitcher = Stitcher(SETTINGS)
    stitcher.cut(0)
    assert stitcher.weave([window_of((0, 2, 4), 1.0), window_of((0, 1, 3, 4), 2.0)])
    stitcher.cut(5)
    stitcher.add(window_of((5, 6), 9.0))
    out = stitcher.take()
    assert [item.segment for item in out] == [0] * 5 + [1] * 2
    np.testing.assert_array_equal(out[5].world_from_camera, np.eye(4))
    assert stitcher.warnings == ["a cut at frame 5: what follows has a world and scale of its own"]


def test_frames_given_out_are_never_changed_by_a_window_that_was_moved_back() -> None:
    stitcher = Stitcher(SETTINGS)
    stitcher.add([frame(i, 1.0) for i in range(6)])
    out = stitcher.take(4)
    assert [item.index for item in out] == [0, 1, 2, 3]
    stitcher.add([frame(i, 1.0) for i in range(1, 7)])
    out += stitcher.take()
    assert [item.index for item in out] == list(range(7))

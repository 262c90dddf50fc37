"""Frames that windows placed wrongly, refined by sights of a world that is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from bathyscope.camera import F64, invert_pose, rotation_angle
from bathyscope_serve.engine_settings import RefineSettings
from bathyscope_serve.placed import PlacedFrame, Sight
from bathyscope_serve.refine.adjustment import rotations
from bathyscope_serve.refine.refiner import Refiner

SIZE = (42, 56)
FOCAL = 50.0
K = np.array([[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1.0]])
FRAMES = 40


def true_pose(index: int) -> F64:
    """A camera that goes sideways and forward before a wall, and turns a little."""
    pose = np.eye(4)
    pose[:3, :3] = rotations(np.array([[0.0, -0.004 * index, 0.0]]))[0]
    pose[:3, 3] = 0.06 * index, 0.02 * np.sin(index / 3), 0.03 * index
    return pose


def wall(x: F64, y: F64) -> F64:
    """Its z."""
    return 6 + 0.5 * np.sin(1.3 * x) + 0.4 * np.cos(1.7 * y)


def points() -> F64:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-6, 9, 1500), rng.uniform(-5, 5, 1500)
    return np.stack([x, y, wall(x, y)], 1)


def true_depth(pose: F64) -> np.ndarray:
    """Depth (h, w) of the wall, by fixed-point iteration along each ray."""
    u, v = np.meshgrid((np.arange(SIZE[1]) + 0.5 - K[0, 2]) / FOCAL, (np.arange(SIZE[0]) + 0.5 - K[1, 2]) / FOCAL)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ pose[:3, :3].T
    z = np.full(SIZE, 5.0)
    for _ in range(60):
        place = pose[:3, 3] + z[..., None] * rays
        z += 0.7 * (wall(place[..., 0], place[..., 1]) - place[..., 2]) / rays[..., 2]
    return z.astype(np.float32)


def sight(pose: F64, rng: np.random.Generator, wrong: float = 0.0) -> Sight:
    seen = points() @ invert_pose(pose)[:3, :3].T + invert_pose(pose)[:3, 3]
    places = seen[:, :2] / seen[:, 2:] * FOCAL + K[:2, 2]
    inside = ((places > 1) & (places < np.array(SIZE[::-1]) - 1)).all(1) & (seen[:, 2] > 0)
    places = places + 0.02 * rng.normal(size=places.shape)
    places += np.where(rng.uniform(size=(len(places), 1)) < wrong, rng.normal(0, 4, places.shape), 0)
    return Sight(np.nonzero(inside)[0], places[inside].astype(np.float32), 0.33)


def placed(*, drift: float = 0.01, wrong: float = 0.0, seen: bool = True, segment: int = 0) -> list[PlacedFrame]:
    """The frames as windows might have them: their scale drifts by a per cent a frame, and each camera trembles."""
    rng = np.random.default_rng(4)
    frames, place = [], np.zeros(3)
    for index in range(FRAMES):
        truth = true_pose(index)
        if index:
            place = place + np.exp(-drift * index) * (truth[:3, 3] - true_pose(index - 1)[:3, 3])
        pose = np.eye(4)
        pose[:3, :3] = rotations(0.01 * rng.normal(size=(1, 3)) * (index > 0))[0] @ truth[:3, :3]
        pose[:3, 3] = place
        depth = (true_depth(truth) * np.exp(-drift * index)).astype(np.float32)
        one = np.ones(SIZE, np.float32)
        frames.append(
            PlacedFrame(
                index=index,
                timestamp_s=index / 25,
                depth=depth,
                confidence=one,
                known=one > 0,
                world_from_camera=pose,
                intrinsics=K,
                key=index % 2 == 0,
                sight=sight(truth, rng, wrong) if seen else None,
                segment=segment,
            )
        )
    return frames


def refined(frames: list[PlacedFrame], batch: int = 7) -> list[PlacedFrame]:
    refiner, out = Refiner(RefineSettings()), []
    for start in range(0, len(frames), batch):
        out += refiner.add(frames[start : start + batch])
    return out + refiner.finish()


def turn_errors(frames: list[PlacedFrame]) -> F64:
    """Degrees between true and found turns from each frame to the next."""
    errors = []
    for a, b in pairwise(frames):
        found = a.world_from_camera[:3, :3].T @ b.world_from_camera[:3, :3]
        truth = true_pose(a.index)[:3, :3].T @ true_pose(b.index)[:3, :3]
        errors.append(np.degrees(rotation_angle((found @ truth.T)[None])[0]))
    return np.array(errors)


def scales(frames: list[PlacedFrame]) -> F64:
    """Log of found over true depth, frame by frame, from that of the first."""
    ratios = np.array([np.median(np.log(frame.depth / true_depth(true_pose(frame.index)))) for frame in frames])
    return ratios - ratios[0]


@pytest.mark.parametrize(("wrong", "degrees"), [(0.0, 0.08), (0.2, 0.25)])
def test_trembling_cameras_and_drifting_scale_are_mended(wrong: float, degrees: float) -> None:
    frames = placed(wrong=wrong)
    out = refined(frames)
    assert [frame.index for frame in out] == list(range(FRAMES))
    assert turn_errors(frames).mean() > 0.8
    assert turn_errors(out).mean() < degrees
    assert np.abs(scales(frames)).max() > 0.35
    assert np.abs(scales(out)).max() < 0.06
    shape = [np.std(np.log(frame.depth / true_depth(true_pose(frame.index)))) for frame in out]
    assert max(shape) < 0.03


def test_distances_travelled_and_depths_have_one_scale() -> None:
    out = refined(placed())
    centres = np.stack([frame.world_from_camera[:3, 3] for frame in out])
    truth = np.stack([true_pose(index)[:3, 3] for index in range(FRAMES)])
    found = np.linalg.norm(np.diff(centres[::5], axis=0), axis=1)
    ratio = np.log(found / np.linalg.norm(np.diff(truth[::5], axis=0), axis=1))
    assert np.ptp(ratio) < 0.05
    assert abs(np.median(ratio) - np.median(np.log(out[0].depth / true_depth(true_pose(0))))) < 0.05


def test_frames_without_points_leave_as_they_came() -> None:
    frames = placed(seen=False)
    for before, after in zip(frames, refined(frames), strict=True):
        np.testing.assert_allclose(after.depth, before.depth, rtol=1e-6)
        np.testing.assert_allclose(after.world_from_camera, before.world_from_camera, atol=1e-12)


def test_one_odd_key_frame_does_not_set_the_scale_of_what_follows() -> None:
    """The last one with points is half as deep again as it should be; no point is seen twice after it."""
    frames = placed(drift=0.0)
    frames[24] = replace(frames[24], depth=1.5 * frames[24].depth)
    for index in range(25, FRAMES):
        sight = frames[index].sight
        assert sight is not None
        frames[index] = replace(frames[index], sight=replace(sight, ids=sight.ids + 10_000 * index))
    assert np.abs(scales(refined(frames))).max() < 0.05


@pytest.mark.parametrize("lost", [1, 16, 17])
def test_a_frame_that_shows_nothing_lies_on_the_way(lost: int) -> None:
    """Whatever the network says of a black frame, key frame or not; the others are as good as ever."""
    frames = placed()
    pose = frames[lost].world_from_camera.copy()
    pose[:3, :3] = rotations(np.array([[0.3, -0.4, 0.2]]))[0] @ pose[:3, :3]
    nothing = Sight(np.zeros(0, np.int64), np.zeros((0, 2), np.float32), 0.33)
    frames[lost] = replace(frames[lost], world_from_camera=pose, sight=nothing)
    assert turn_errors(frames).max() > 20
    assert turn_errors(refined(frames)).max() < 0.3


def test_errors_of_the_shape_of_depth_are_known_without_the_truth() -> None:
    """Half of the picture a quarter too deep; wandering scale and trembling cameras do not count."""
    told = []
    for wrong in (1.0, 1.25):
        refiner = Refiner(RefineSettings())
        for frame in placed():
            depth = frame.depth.copy()
            depth[:, SIZE[1] // 2 :] *= wrong
            refiner.add([replace(frame, depth=depth)])
        refiner.finish()
        assert refiner.agreement is not None
        assert refiner.agreement.frames > 0.9 * FRAMES
        told.append(refiner.agreement.difference)
    assert told[0] < 0.02
    assert 0.08 < told[1] < 0.14  # a half of 25 %, or of 20 %, by the side that the median is on


def test_sights_that_contradict_each_other_change_nothing() -> None:
    rng = np.random.default_rng(0)
    frames = [
        replace(
            frame,
            sight=Sight(np.arange(200), rng.uniform(2, 40, (200, 2)).astype(np.float32), 0.33),
        )
        for frame in placed()
    ]
    for before, after in zip(frames, refined(frames), strict=True):
        np.testing.assert_allclose(after.depth, before.depth, rtol=1e-6)
        np.testing.assert_allclose(after.world_from_camera, before.world_from_camera, atol=1e-9)


def test_segments_are_refined_by_themselves() -> None:
    first = placed()
    second = [replace(frame, index=frame.index + FRAMES, segment=1) for frame in placed()]
    out = refined([*first, *second])
    assert [frame.index for frame in out] == list(range(2 * FRAMES))
    np.testing.assert_allclose(out[FRAMES].world_from_camera, out[0].world_from_camera, atol=1e-9)
    np.testing.assert_allclose(out[-1].depth, out[FRAMES - 1].depth, rtol=1e-5)


def test_a_lens_that_the_windows_do_not_agree_about_is_one_lens() -> None:
    frames = [
        replace(frame, intrinsics=np.diag([1 + 0.05 * (-1) ** frame.index, 1 + 0.05 * (-1) ** frame.index, 1]) @ K)
        for frame in placed()
    ]
    out = refined(frames)
    assert len({frame.intrinsics[0, 0] for frame in out}) == 1


def test_how_frames_arrive_does_not_matter_and_few_are_held() -> None:
    frames = placed()
    whole, single = refined(frames, FRAMES), refined(frames, 1)
    for a, b in zip(whole, single, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
    refiner, given = Refiner(RefineSettings(step=2, wait=2)), 0
    for number, frame in enumerate(frames):
        given += len(refiner.add([frame]))
        assert number + 1 - given <= 10

"""How rendered cameras move: as slowly as asked, round a point, in parallel, with stops, in a trembling hand."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import least_squares

from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.clip import plan_clip, render_clip
from bathyscope_train.data.synthetic.domain import CameraRanges
from bathyscope_train.data.synthetic.scene import NOTHING
from bathyscope_train.data.synthetic.solid_tracing import solid_clearance
from bathyscope_train.data.synthetic.tracing import clearance

Array = npt.NDArray[np.float64]
FAMILIES = ("lumen", "cavity", "sinus", "larynx", "closeup", "indoor")
SIZE = (16, 20)


def path_of(seed: int, family: str, *, frames: int = 16, **camera: object) -> Array:
    ranges = CameraRanges(**camera)  # type: ignore[arg-type]
    domain = DOMAINS["source"].model_copy(update={"families": {family: 1.0}, "camera": ranges})
    return plan_clip(seed, domain, frames=frames, size=SIZE).scene_from_camera


def turned(first: Array, second: Array) -> float:
    """Degrees between two poses."""
    cosine = (np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("family", FAMILIES)
def test_the_camera_is_in_free_space_all_the_time(family: str) -> None:
    domain = DOMAINS["broad"].model_copy(update={"families": {family: 1.0}})
    for seed in range(5):
        plan = plan_clip(seed, domain, frames=16, size=SIZE)
        for frame, pose in enumerate(plan.scene_from_camera):
            scene, point = plan.scene_at(frame), pose[:3, 3]
            assert solid_clearance(scene.solids, *point) > 0
            assert scene.surface.kind == NOTHING or clearance(scene.surface, point) > 0


def test_a_camera_that_hugs_the_wall_is_nearer_to_it_and_sees_the_way_ahead() -> None:
    """The same tubes and speeds: the wall comes nearer, and depth spreads further in a picture."""
    near, spread = [], []
    for seed in range(6):
        usual, hugging = (
            DOMAINS["tubes"].model_copy(
                update={
                    "families": {"lumen": 1.0},
                    "camera": DOMAINS["tubes"].camera.model_copy(update={"hugging": share}),
                }
            )
            for share in (0.0, 1.0)
        )
        clips = [render_clip(seed, domain, frames=3, size=(28, 36)) for domain in (usual, hugging)]
        plans = [plan_clip(seed, domain, frames=3, size=SIZE) for domain in (usual, hugging)]
        near.append([min(clearance(p.scene.surface, pose[:3, 3]) for pose in p.scene_from_camera) for p in plans])
        assert min(near[-1]) > 0
        assert clips[0].intrinsics == pytest.approx(clips[1].intrinsics)
        low, high = zip(*(np.quantile(clip.depth[clip.valid], (0.02, 0.98)) for clip in clips), strict=True)
        spread.append(np.divide(high, low))
    assert np.median(near, 0)[1] < 0.5 * np.median(near, 0)[0]
    assert np.median(spread, 0)[1] > 1.5 * np.median(spread, 0)[0]


def test_a_slow_clip_moves_as_much_less_as_its_speed_says() -> None:
    usual = {"speed": (1.0, 1.0), "motions": {"turning": 1.0}}
    for seed in range(4):
        fast = path_of(seed, "closeup", **usual)
        slow = path_of(seed, "closeup", slow=1.0, slow_speed=(0.1, 0.1), **usual)
        ratio = turned(slow[0], slow[6]) / turned(fast[0], fast[6])
        assert 0.05 < ratio < 0.2
        np.testing.assert_allclose(slow[0, :3, 3], fast[0, :3, 3], atol=1e-9)


@pytest.mark.slow
def test_the_broad_domain_has_clips_as_slow_as_a_hand_that_holds_still_and_fast_ones() -> None:
    plans = (plan_clip(seed, DOMAINS["broad"], frames=16, size=SIZE) for seed in range(24))
    degrees = np.array([turned(*plan.scene_from_camera[[0, 6]]) for plan in plans])
    assert np.mean(degrees < 1.5) > 0.15
    assert np.mean(degrees > 5.0) > 0.15


def test_an_orbit_keeps_one_point_at_its_place_in_the_picture_but_for_its_sway() -> None:
    for seed in range(4):
        poses = path_of(seed, "closeup", speed=(1.0, 1.0), motions={"orbit": 1.0})

        def drift(point: Array, poses: Array = poses) -> Array:
            seen = np.einsum("tji,tj->ti", poses[:, :3, :3], point - poses[:, :3, 3])
            seen /= np.linalg.norm(seen, axis=1, keepdims=True)
            return np.asarray((seen - seen.mean(0)).ravel())

        ahead = poses[0, :3, 3] + 15.0 * poses[0, :3, 2]
        off = np.degrees(np.abs(least_squares(drift, ahead).fun).max())
        swept = turned(*poses[[0, -1]])
        assert swept > 4.0
        assert off < 0.2 * swept


def test_a_parallel_path_hardly_turns_while_it_travels() -> None:
    parallel = path_of(2, "closeup", speed=(1.0, 1.0), motions={"parallel": 1.0})
    orbit = path_of(2, "closeup", speed=(1.0, 1.0), motions={"orbit": 1.0})
    assert np.linalg.norm(np.diff(parallel[:, :3, 3], axis=0), axis=1).sum() > 1.0
    assert turned(*parallel[[0, -1]]) < 6.0 < turned(*orbit[[0, -1]])


def test_a_pausing_camera_stops_on_the_path_that_it_would_have_taken() -> None:
    stops = 0
    for seed in range(3):
        free, paused = (path_of(seed, "lumen", speed=(1.0, 1.0), pausing=share) for share in (0.0, 1.0))
        np.testing.assert_allclose(paused[0], free[0], atol=1e-9)
        stops += sum(np.allclose(a, b, atol=1e-9) for a, b in pairwise(paused))
        for pose in paused:
            apart = np.linalg.norm(free[:, :3, 3] - pose[:3, 3], axis=1)
            assert apart.min() < 0.6 * np.linalg.norm(np.diff(free[:, :3, 3], axis=0), axis=1).max()
        assert not any(np.allclose(a, b, atol=1e-9) for a, b in pairwise(free))
    assert stops > 2


def test_a_trembling_hand_adds_turns_of_the_stated_size_and_no_drift() -> None:
    calm, shaken = (
        path_of(1, "cavity", frames=64, speed=(0.2, 0.2), trembling=share, tremor_deg=(0.3, 0.3))
        for share in (0.0, 1.0)
    )
    extra = np.array([turned(a, b) for a, b in zip(calm, shaken, strict=True)])
    assert 0.1 < np.sqrt((extra**2).mean()) < 0.9
    assert extra[-16:].mean() < 2 * extra[:16].mean()
    rough = [np.abs(np.diff(path[:, :3, 2], n=2, axis=0)).mean() for path in (calm, shaken)]
    assert rough[1] > 3 * rough[0]

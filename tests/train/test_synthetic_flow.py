"""Optical flow of rendered clips: closed forms for a plane, agreement with what was rendered, old clips."""

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic import DOMAINS, Domain, SyntheticClip, optical_flow, read_clip, render_clip
from bathyscope_train.data.synthetic.clip import plan_clip, render_frame_of
from bathyscope_train.data.synthetic.domain import LifeRanges
from bathyscope_train.data.synthetic.lens import PINHOLE, Distortion, undistort
from bathyscope_train.data.synthetic.shards import write_clip
from bathyscope_train.data.synthetic.swell import carried, swollen
from bathyscope_train.data.synthetic.tracing import at_rest

Array = npt.NDArray[np.float64]
SIZE = (40, 50)
K = np.array([[45.0, 0.0, 25.0], [0.0, 45.0, 20.0], [0.0, 0.0, 1.0]])
FAMILIES = ("lumen", "cavity", "sinus", "larynx", "closeup", "indoor")


def pixels(size: tuple[int, int] = SIZE) -> Array:
    rows, columns = np.mgrid[: size[0], : size[1]]
    return np.stack([columns + 0.5, rows + 0.5], axis=-1)


def pose(rotation: Array | None = None, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    matrix[:3, 3] = shift
    return matrix


def plane_clip(target: Array, depth: float, after: float, distortion: Distortion = PINHOLE) -> SyntheticClip:
    """A wall straight ahead, seen from the identity and from ``target`` with depth ``after``."""
    return SyntheticClip(
        frames=np.zeros((2, *SIZE, 3), np.uint8),
        depth=np.stack([np.full(SIZE, value, np.float32) for value in (depth, after)]),
        valid=np.ones((2, *SIZE), bool),
        world_from_camera=np.stack([np.eye(4), target]),
        intrinsics=K,
        distortion=distortion,
        mover=np.zeros((2, *SIZE), np.uint8),
        world_from_mover=np.zeros((2, 0, 4, 4)),
        swell=None,
        name="plane",
        seed=0,
        domain="none",
    )


def test_a_plane_flows_by_focal_length_times_shift_over_depth() -> None:
    flow = optical_flow(plane_clip(pose(shift=(2.0, -1.0, 0.0)), 30.0, 30.0), 0, 1)
    np.testing.assert_allclose(flow.flow, np.broadcast_to((-3.0, 1.5), (*SIZE, 2)), atol=1e-5)
    np.testing.assert_allclose(flow.depth, 30.0)
    ends = pixels() + np.array((-3.0, 1.5))
    np.testing.assert_array_equal(flow.visible, (ends >= 0).all(-1) & (ends <= (50, 40)).all(-1))


def test_going_forward_the_flow_of_a_plane_spreads_from_the_middle() -> None:
    flow = optical_flow(plane_clip(pose(shift=(0.0, 0.0, 10.0)), 30.0, 20.0), 0, 1)
    np.testing.assert_allclose(flow.flow, (pixels() - (25.0, 20.0)) * 0.5, atol=1e-5)
    np.testing.assert_allclose(flow.depth, 20.0)


@pytest.mark.parametrize("lens", [PINHOLE, Distortion(-0.3, 0.09)], ids=["pinhole", "barrel"])
def test_a_roll_turns_the_pixels_about_the_middle_whatever_the_lens(lens: Distortion) -> None:
    angle = 0.3
    turn = Rotation.from_rotvec((0.0, 0.0, angle)).as_matrix()
    flow = optical_flow(plane_clip(pose(turn), 30.0, 30.0, lens), 0, 1)
    ends = (pixels() - (25.0, 20.0)) @ turn[:2, :2] + (25.0, 20.0)
    np.testing.assert_allclose(flow.flow, ends - pixels(), atol=1e-5)


def test_a_point_before_which_something_stands_in_the_target_is_not_visible() -> None:
    clip = plane_clip(np.eye(4), 30.0, 30.0)
    clip.depth[1, :, 25:] = 12.0
    flow = optical_flow(clip, 0, 1)
    np.testing.assert_array_equal(flow.visible[:, :24], True)
    np.testing.assert_array_equal(flow.visible[:, 27:], False)
    assert flow.valid.all()


def test_what_an_instrument_covers_moves_with_the_instrument() -> None:
    clip = plane_clip(np.eye(4), 30.0, 30.0)
    clip.mover[0, 10:20, 10:20] = 1
    path = np.stack([pose(shift=(5.0, 0.0, 0.0)), pose(shift=(7.0, 1.0, 0.0))])[:, None]
    flow = optical_flow(replace(clip, world_from_mover=path), 0, 1).flow
    np.testing.assert_allclose(flow[clip.mover[0] == 1], np.broadcast_to((3.0, 1.5), (100, 2)), atol=1e-5)
    np.testing.assert_allclose(flow[clip.mover[0] == 0], 0.0, atol=1e-6)


def test_frames_that_are_not_there_are_refused() -> None:
    with pytest.raises(SettingsError, match="clip of 2"):
        optical_flow(plane_clip(np.eye(4), 30.0, 30.0), 0, 2)


def alive(family: str, **life: object) -> Domain:
    source = DOMAINS["source"]
    camera = source.camera.model_copy(update={"distorted": 1.0})
    return source.model_copy(update={"families": {family: 1.0}, "life": LifeRanges(**life), "camera": camera})  # type: ignore[arg-type]


def landing_error(clip: SyntheticClip, source: int, target: int, *, rigid: bool = False) -> Array:
    """Relative difference of the carried depth and the depth rendered where the flow ends, of visible pixels."""
    used = replace(clip, swell=None, mover=np.zeros_like(clip.mover)) if rigid else clip
    flow = optical_flow(used, source, target)
    u, v = (np.float32(flow.flow[..., i] + pixels((56, 70))[..., i] - 0.5) for i in range(2))
    shown = cv2.remap(clip.depth[target], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    assert flow.visible.mean() > 0.25
    return np.asarray(np.abs(shown / np.maximum(flow.depth, 1e-6) - 1)[flow.visible])


@pytest.mark.parametrize("family", FAMILIES)
def test_where_the_flow_ends_the_target_shows_the_depth_that_it_states(family: str) -> None:
    clip = render_clip(4, alive(family), frames=4, size=(56, 70))
    error = landing_error(clip, 0, 3)
    assert np.median(error) < 0.003
    assert np.mean(error < 0.02) > 0.9
    flow = optical_flow(clip, 2, 2)
    np.testing.assert_allclose(flow.flow, 0.0, atol=1e-3)
    np.testing.assert_array_equal(flow.visible, clip.valid[2])


@pytest.mark.parametrize("family", ["lumen", "cavity"])
@pytest.mark.parametrize("what", ["breathing", "peristalsis"])
def test_tissue_that_moves_is_followed_where_a_rigid_scene_would_err(family: str, what: str) -> None:
    domain = alive(family, **{what: 1.0, "amplitude": (0.06, 0.06), "period": (10.0, 10.0)})
    clip = render_clip(3, domain, frames=5, size=(56, 70))
    assert clip.swell is not None
    followed, rigid = landing_error(clip, 0, 4), landing_error(clip, 0, 4, rigid=True)
    assert np.median(followed) < 0.0025
    assert np.median(followed) < 0.3 * np.median(rigid)


@pytest.mark.parametrize("family", ["lumen", "cavity"])
def test_the_texture_of_a_point_stays_the_one_it_has_at_rest_while_the_point_moves(family: str) -> None:
    domain = alive(family, breathing=1.0, peristalsis=1.0, amplitude=(0.06, 0.06))
    plan = plan_clip(3, domain, frames=9, size=SIZE)
    assert plan.swell is not None
    still = render_frame_of(replace(plan, swell=None), 0)
    depth = still.depth[::8, ::8].astype(float)[..., None]
    rays = np.concatenate([undistort((pixels() - K[:2, 2]) / 45.0, PINHOLE), np.ones((*SIZE, 1))], axis=-1)[::8, ::8]
    points = (rays * depth) @ plan.scene_from_camera[0][:3, :3].T + plan.scene_from_camera[0][:3, 3]
    early, late = swollen(plan.scene.surface, plan.swell, 2), swollen(plan.scene.surface, plan.swell, 7)
    for point in points.reshape(-1, 3):
        moved = carried(plan.swell, point, 2, 7)
        np.testing.assert_allclose(at_rest(early, *point), at_rest(late, *moved), atol=2e-3)
    assert at_rest(plan.scene.surface, 1.0, 2.0, 30.0) == (1.0, 2.0, 30.0)


def test_tissue_that_moves_by_nothing_gives_the_bytes_of_still_tissue() -> None:
    still = render_clip(5, alive("lumen"), frames=2, size=SIZE)
    moved = render_clip(5, alive("lumen", breathing=1.0, peristalsis=1.0, amplitude=(0.0, 0.0)), frames=2, size=SIZE)
    assert moved.swell is not None
    for field in fields(still):
        if field.name not in {"swell", "name"}:
            np.testing.assert_array_equal(getattr(moved, field.name), getattr(still, field.name))


def test_instruments_are_labelled_stand_before_the_tissue_and_are_followed() -> None:
    shares = []
    for seed in range(4):
        clip, bare = (
            render_clip(seed, alive("cavity", instruments=share), frames=4, size=(56, 70)) for share in (1.0, 0.0)
        )
        covered = clip.moving
        shares.append(covered.mean())
        assert (clip.depth[covered] < bare.depth[covered]).all()
        np.testing.assert_array_equal(clip.depth[~covered], bare.depth[~covered])
        np.testing.assert_array_equal(clip.world_from_camera, bare.world_from_camera)
        assert clip.world_from_mover.shape[1] in {1, 2}
        assert clip.mover.max(initial=0) <= clip.world_from_mover.shape[1]
        error = landing_error(clip, 0, 3)
        assert np.mean(error < 0.02) > 0.9
    assert 0.01 < np.mean(shares) < 0.3
    assert max(shares) < 0.7


def test_a_moving_clip_comes_back_from_disk(tmp_path: Path) -> None:
    clip = render_clip(2, alive("lumen", instruments=1.0, breathing=1.0), frames=3, size=SIZE)
    write_clip(tmp_path / "clip.npz", clip)
    stored = read_clip(tmp_path / "clip.npz")
    expected, observed = optical_flow(clip, 0, 2), optical_flow(stored, 0, 2)
    np.testing.assert_allclose(observed.flow, expected.flow, atol=0.02)  # depth is stored in 16 bits
    np.testing.assert_array_equal(stored.mover, clip.mover)
    assert stored.distortion == clip.distortion
    assert stored.swell is not None
    np.testing.assert_array_equal(stored.swell.waves, clip.swell.waves if clip.swell else None)


def test_clips_written_before_anything_moved_are_read_as_still_and_unbent(tmp_path: Path) -> None:
    clip = render_clip(1, DOMAINS["source"], frames=2, size=SIZE)
    write_clip(tmp_path / "new.npz", clip)
    with np.load(tmp_path / "new.npz") as file:
        old = {name: file[name] for name in file if name not in {"distortion", "mover", "world_from_mover"}}
    np.savez(tmp_path / "old.npz", **old)
    stored = read_clip(tmp_path / "old.npz")
    assert stored.distortion == PINHOLE
    assert stored.swell is None
    assert not stored.moving.any()
    assert stored.world_from_mover.shape == (2, 0, 4, 4)
    np.testing.assert_array_equal(stored.frames, clip.frames)

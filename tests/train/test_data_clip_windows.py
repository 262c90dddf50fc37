"""Windows of videos without ground truth: which frames, what is left out, and the same draws whoever draws."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_videos import write_video
from numpy.typing import NDArray

from bathyscope.errors import DatasetError
from bathyscope.vision.field_of_view import FieldOfView
from bathyscope.vision.grid import Grid
from bathyscope_train.data.clip_changes import (
    ClipChanges,
    crop_view,
    draw_changes,
    mirror_frames,
    mirror_intrinsics,
    recolour,
)
from bathyscope_train.data.clip_loader import WindowLoader
from bathyscope_train.data.clip_pictures import to_model_quickly
from bathyscope_train.data.clip_sources import ClipSource, open_sources, open_windows
from bathyscope_train.data.clip_survey import survey_clip
from bathyscope_train.data.clip_windows import WindowSettings, choose_frames, intrinsics_at
from bathyscope_train.data.datasets.videos import open_videos
from bathyscope_train.data.survey_files import ClipSurvey

SIZE = (56, 84)
PLAIN = WindowSettings(frames=4, size=(28, 42), changes=ClipChanges.none(), motion_jitter=1)


def wall(seed: int = 0) -> NDArray[np.uint8]:
    """A wide textured wall to pan over."""
    noise = np.random.default_rng(seed).uniform(60, 220, (SIZE[0] // 4, 150, 3)).astype(np.float32)
    if seed:
        noise[..., seed % 3] *= 0.4
    return cv2.resize(noise, (600, SIZE[0]), interpolation=cv2.INTER_CUBIC).clip(40, 255).astype(np.uint8)


def pan(offsets: list[int], seed: int = 0) -> list[NDArray[np.uint8]]:
    """Views of the wall, this many columns to the right."""
    return [wall(seed)[:, x : x + SIZE[1]] for x in offsets]


def write_frames(folder: Path, frames: list[NDArray[np.uint8]]) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(frames):
        cv2.imwrite(str(folder / f"{number:03d}.png"), image[..., ::-1])
    return folder


def survey(folder: Path) -> ClipSurvey:
    (sequence,) = open_videos(folder).sequences
    return survey_clip(sequence)


def test_motion_is_the_flow_as_a_share_of_the_width(tmp_path: Path) -> None:
    found = survey(write_frames(tmp_path / "a", pan([3 * k for k in range(8)])))
    np.testing.assert_array_equal(found.kept, range(8))
    np.testing.assert_allclose(found.motion[1:], 3 / SIZE[1], rtol=0.1)
    assert found.motion[0] == 0


def test_frames_that_show_nothing_new_are_left_out_and_counted(tmp_path: Path) -> None:
    found = survey(write_frames(tmp_path / "a", pan([0, 0, 0, 3, 3, 6, 9, 9])))
    np.testing.assert_array_equal(found.kept, [0, 3, 5, 6])
    assert found.notes == ("4 frames show nothing new and are left out",)


def test_a_cut_ends_a_shot_and_no_window_crosses_it(tmp_path: Path) -> None:
    frames = pan([3 * k for k in range(6)], seed=1) + pan([3 * k for k in range(9)], seed=2)
    found = survey(write_frames(tmp_path / "a", frames))
    np.testing.assert_array_equal(found.shots, [0, 6, 15])
    random = np.random.default_rng(0)
    starts = set()
    for _ in range(200):
        chosen = choose_frames(found, PLAIN, random)
        assert (chosen[0] < 6) == (chosen[-1] < 6)
        starts.add(chosen[0])
    assert {0, 1, 2, 6, 7} <= starts


@pytest.mark.parametrize(("pixels", "stride"), [(4, 1), (2, 2), (1, 4)])
def test_the_stride_grows_until_the_camera_moves_enough(tmp_path: Path, pixels: int, stride: int) -> None:
    found = survey(write_frames(tmp_path / "a", pan([pixels * k for k in range(40)])))
    settings = PLAIN.model_copy(update={"motion": 3.6 / SIZE[1]})
    chosen = choose_frames(found, settings, np.random.default_rng(0))
    assert set(np.diff(chosen)) == {stride}


def test_the_stride_stays_below_its_bound_and_inside_the_shot(tmp_path: Path) -> None:
    found = survey(write_frames(tmp_path / "a", pan(list(range(12)))))
    far = PLAIN.model_copy(update={"motion": 0.5})
    assert set(np.diff(choose_frames(found, far, np.random.default_rng(0)))) == {3}  # 12 frames hold 4 at 3 apart
    near = far.model_copy(update={"max_stride": 2})
    assert set(np.diff(choose_frames(found, near, np.random.default_rng(0)))) == {2}


def test_black_damaged_and_odd_frames_among_good_ones_are_named_and_left_out(tmp_path: Path) -> None:
    frames = pan([3 * k for k in range(10)])
    frames[4] = np.full_like(frames[4], 3)
    folder = write_frames(tmp_path / "a", frames)
    (folder / "006.png").write_bytes(b"\x89PNG no picture")
    cv2.imwrite(str(folder / "008.png"), frames[8][:20, :20])
    found = survey(folder)
    np.testing.assert_array_equal(found.kept, [0, 1, 2, 3, 5, 7, 9])
    assert len(found.shots) == 2  # what was left out is no cut
    notes = "; ".join(found.notes)
    assert "1 frames cannot be read" in notes
    assert "006.png" in notes
    assert "008.png (20x20)" in notes
    assert "1 black frames are left out, first number 4" in notes


def test_a_black_video_and_one_too_short_are_named_while_the_rest_is_used(tmp_path: Path) -> None:
    write_frames(tmp_path / "black", [np.zeros((*SIZE, 3), np.uint8)] * 8)
    write_frames(tmp_path / "short", pan([0, 3]))
    write_frames(tmp_path / "standing", pan([5] * 8))
    write_frames(tmp_path / "good", pan([3 * k for k in range(8)]))
    write_video(tmp_path / "single.mp4", pan([0]))
    windows = open_windows([ClipSource(folder=tmp_path)], PLAIN)
    assert [sequence.name for sequence, _ in windows.clips] == ["good"]
    notes = "\n".join(windows.notes)
    assert "black: no frame can be used: 8 black frames" in notes
    assert "short: left out: its longest shot has 2 frames" in notes
    assert "standing: left out: its longest shot has 1 frames" in notes
    assert "single.mp4: 1 frame; a clip to train on needs at least 2" in notes


def test_data_without_one_window_is_refused_with_the_reasons(tmp_path: Path) -> None:
    write_frames(tmp_path / "a", pan([0, 3, 6]))
    with pytest.raises(DatasetError, match=r"no video holds a window of 4 frames: a: left out: its longest shot has 3"):
        open_windows([ClipSource(folder=tmp_path)], PLAIN)


def moving(tmp_path: Path) -> list[ClipSource]:
    write_frames(tmp_path / "data" / "a", pan([3 * k for k in range(16)], seed=1))
    write_frames(tmp_path / "data" / "b", pan([2 * k for k in range(16)], seed=2))
    return [ClipSource(folder=tmp_path / "data")]


def test_a_window_is_a_function_of_seed_step_and_place(tmp_path: Path) -> None:
    sources, settings = moving(tmp_path), WindowSettings(frames=4, size=(28, 42))
    windows, again = (open_windows(sources, settings, seed=5) for _ in range(2))
    for step, slot in ((0, 0), (7, 1)):
        np.testing.assert_array_equal(windows.draw(step, slot).frames, again.draw(step, slot).frames)
    different = [windows.draw(0, 1), windows.draw(1, 0), open_windows(sources, settings, seed=6).draw(0, 0)]
    first = windows.draw(0, 0)
    assert all(not np.array_equal(first.frames, other.frames) for other in different)
    assert {windows.draw(step).name for step in range(20)} == {"a", "b"}


def test_workers_a_later_start_and_several_processes_draw_the_same_batches(tmp_path: Path) -> None:
    windows = open_windows(moving(tmp_path), WindowSettings(frames=4, size=(28, 42)))

    def batches(steps: int, **options: int) -> list[torch.Tensor]:
        with WindowLoader(windows, **options) as loader:
            return [next(loader).images for _ in range(steps)]

    alone = batches(4, batch=2, workers=0)
    for made in (batches(4, batch=2, workers=2, ahead=2), batches(2, batch=2, workers=0, start=2)):
        for expected, found in zip(alone[-len(made) :], made, strict=True):
            torch.testing.assert_close(found, expected, rtol=0, atol=0)
    halves = [batches(4, workers=0, rank=rank, world_size=2) for rank in (0, 1)]
    for expected, left, right in zip(alone, *halves, strict=True):
        torch.testing.assert_close(torch.cat([left, right]), expected, rtol=0, atol=0)


def test_what_the_first_pass_found_is_kept_and_made_again_when_files_change(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", pan([3 * k for k in range(6)]))
    (sequence,) = open_videos(folder).sequences
    first = survey_clip(sequence, cache=tmp_path / "cache")
    (kept,) = (tmp_path / "cache").iterdir()
    written = kept.stat().st_mtime_ns
    again = survey_clip(sequence, cache=tmp_path / "cache")
    assert kept.stat().st_mtime_ns == written
    for name in ("kept", "motion", "shots"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    np.testing.assert_array_equal(again.view.mask, first.view.mask)
    cv2.imwrite(str(folder / "002.png"), np.zeros((*SIZE, 3), np.uint8))
    assert 2 not in survey_clip(sequence, cache=tmp_path / "cache").kept
    kept.write_bytes(b"damaged")
    np.testing.assert_array_equal(survey_clip(sequence).shots, [0, 5])


def test_borders_are_cut_off_and_what_is_outside_a_round_view_is_black_and_not_inside(tmp_path: Path) -> None:
    y, x = np.mgrid[:120, :160]
    disc = (x - 80) ** 2 + (y - 60) ** 2 < 55**2
    noise = np.random.default_rng(0).uniform(90, 220, (30, 60, 3)).astype(np.float32)
    big = cv2.resize(noise, (240, 120), interpolation=cv2.INTER_CUBIC).clip(70, 255).astype(np.uint8)
    frames = [np.where(disc[..., None], big[:, 4 * k : 4 * k + 160], 0).astype(np.uint8) for k in range(8)]
    folder = write_frames(tmp_path / "a", frames)
    windows = open_windows(
        [ClipSource(folder=folder)], WindowSettings(frames=4, pixels=56 * 56, changes=ClipChanges.none())
    )
    window = windows.draw(0)
    assert abs(window.frames.shape[3] / window.frames.shape[2] - 1) < 0.3  # the disc, not the frame
    assert not window.inside[0, 0]
    assert window.inside[window.inside.shape[0] // 2, window.inside.shape[1] // 2]
    np.testing.assert_array_equal(window.frames[:, :, 0, 0], 0)


def test_quick_pictures_are_those_of_serving_but_for_rounding() -> None:
    image = np.random.default_rng(0).integers(0, 256, (90, 130, 3)).astype(np.uint8)
    y, x = np.mgrid[:90, :130]
    for mask in (np.ones((90, 130), np.bool_), (x - 60) ** 2 + (y - 40) ** 2 < 38**2):
        grid = Grid.of(FieldOfView(mask, "hull"), (28, 42))
        np.testing.assert_allclose(to_model_quickly(grid, image), grid.to_model(image), atol=0.51 / 255)


def own_folder(path: Path, offsets: list[int], **calibration: object) -> Path:
    write_frames(path / "frames", pan(offsets))
    camera = {"width": SIZE[1], "height": SIZE[0], "fx": 80.0, "fy": 70.0, "cx": 40.0, "cy": 30.0, "pose_unit": "mm"}
    (path / "intrinsics.json").write_text(json.dumps({**camera, **calibration}))
    lines = []
    for number, offset in enumerate(offsets):
        pose = np.eye(4)
        pose[0, 3] = offset
        lines.append(" ".join([f"{number:03d}.png", *map(str, pose.ravel())]))
    (path / "poses.txt").write_text("\n".join(lines))
    return path


def test_our_own_folders_need_no_truth_and_bring_camera_and_poses(tmp_path: Path) -> None:
    folder = own_folder(tmp_path / "own", [3 * k for k in range(8)])
    window = open_windows([ClipSource(folder=folder)], PLAIN).draw(0)
    assert (window.intrinsics is None, window.world_from_camera is None) == (False, False)
    assert window.world_from_camera is not None
    np.testing.assert_allclose(window.intrinsics, [[40, 0, 20], [0, 35, 15], [0, 0, 1]])
    expected = 3.0 * (np.array(window.indices) - window.indices[0])
    np.testing.assert_allclose(window.world_from_camera[:, 0, 3], expected)


def test_points_keep_their_pixels_under_every_change(tmp_path: Path) -> None:
    # A wall at z = 80 that the camera slides along: a point's pixel from camera and pose must show the same colour
    # in all frames, whatever was mirrored, cropped and turned round in time.
    folder = own_folder(tmp_path / "own", [3 * k for k in range(12)], fx=80.0, fy=80.0)
    changes = ClipChanges(gamma=(1, 1), gain=(1, 1), tint=0, crop_chance=1, crop=0.7, mirror_chance=0.5)
    settings = WindowSettings(frames=3, size=(56, 84), changes=changes)
    windows = open_windows([ClipSource(folder=folder)], settings)
    seen = set()
    for step in range(6):
        window = windows.draw(step)
        assert window.intrinsics is not None
        assert window.world_from_camera is not None
        seen.add((window.world_from_camera[1, 0, 3] > 0, window.indices[1] > window.indices[0]))
        step_px = window.world_from_camera[1, 0, 3] / 80.0 * window.intrinsics[0, 0]
        shift = round(float(step_px))
        a, b = window.frames[0], window.frames[1]
        moved = np.roll(b, shift, axis=2)[..., 12:-12]
        still = np.abs(b - a)[..., 12:-12].mean()
        assert np.abs(moved - a[..., 12:-12]).mean() < 0.35 * still
    assert len(seen) > 1


@pytest.mark.parametrize("flip", [(False, False), (True, False), (False, True), (True, True)])
def test_camera_follows_crop_and_mirrors(flip: tuple[bool, bool]) -> None:
    # A picture whose red is u and green v, at source size; a point must be found where the new camera puts it.
    height, width = 80, 120
    v, u = np.mgrid[:height, :width] + 0.5
    image = np.stack([u, v, 0 * u], -1).astype(np.uint8)
    camera = np.array([[90.0, 0, 55], [0, 95.0, 45], [0, 0, 1]])
    drawn = replace(draw_changes(ClipChanges(), np.random.default_rng(1)), share=0.7, place=(0.2, 0.9), flip=flip)
    view = crop_view(FieldOfView(np.ones((height, width), np.bool_), "full"), drawn)
    grid = Grid.of(view, (28, 42))
    picture = mirror_frames(to_model_quickly(grid, image), drawn) * 255
    turned = mirror_intrinsics(intrinsics_at(camera, grid), grid.size, drawn)
    point = np.array([0.1, -0.08, 1.0])
    expected = camera @ point
    sign = np.array([-1 if flip[0] else 1, -1 if flip[1] else 1, 1])
    column, row, _ = turned @ (sign * point)
    found = picture[:2, int(row), int(column)]
    np.testing.assert_allclose(found, expected[:2], atol=2.5)  # a pixel of the window covers two of the source


def test_colour_changes_are_the_same_for_all_frames_and_black_stays_black() -> None:
    drawn = draw_changes(ClipChanges(), np.random.default_rng(3))
    frames = np.linspace(0, 1, 24, dtype=np.float32).reshape(1, 3, 2, 4).repeat(3, 0)
    changed = recolour(frames, drawn)
    np.testing.assert_array_equal(changed[0], changed[2])
    assert changed[0, 0, 0, 0] == 0
    assert 0 <= changed.min() <= changed.max() <= 1
    expected = np.clip(0.5**drawn.gamma * drawn.gain, 0, 1)
    np.testing.assert_allclose(recolour(np.full((1, 3, 1, 1), 0.5, np.float32), drawn)[0, :, 0, 0], expected, rtol=1e-5)


def test_a_range_of_frames_and_shares_can_be_asked_for(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", pan([3 * k for k in range(12)]))
    source = ClipSource(folder=folder, first=2, last=9, share=3.0)
    opened = open_sources([source])
    assert (len(opened.sequences[0]), opened.sequences[0].frame_names[0], opened.shares) == (7, "002.png", (3.0,))
    with pytest.raises(DatasetError, match="it has no frame from 50 on"):
        open_sources([ClipSource(folder=folder, first=50)])


def test_windows_of_two_sizes_do_not_make_a_batch(tmp_path: Path) -> None:
    write_frames(tmp_path / "data" / "wide", pan([3 * k for k in range(8)]))
    write_frames(tmp_path / "data" / "tall", [image[:, :40] for image in pan([2 * k for k in range(8)])])
    windows = open_windows([ClipSource(folder=tmp_path / "data")], WindowSettings(frames=4, pixels=2500))
    with WindowLoader(windows, batch=6, workers=0) as loader, pytest.raises(DatasetError, match="differ in size"):
        next(loader)


def test_a_frame_that_disappears_stops_training_with_its_name(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", pan([3 * k for k in range(4)]))
    windows = open_windows([ClipSource(folder=folder)], PLAIN)
    (folder / "002.png").unlink()
    with WindowLoader(windows, workers=1) as loader, pytest.raises(DatasetError, match=r"002\.png: the frame is miss"):
        next(loader)


def test_windows_are_made_of_whole_patches() -> None:
    with pytest.raises(ValueError, match="not made of whole patches"):
        WindowSettings(size=(30, 42))


def test_worker_processes_and_readers_do_not_load_torch() -> None:
    code = "import sys, bathyscope_train.data.clip_workers; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_videos_beside_folders_of_our_own_are_used_too(tmp_path: Path) -> None:
    own_folder(tmp_path / "own", [3 * k for k in range(6)])
    write_frames(tmp_path / "other" / "clip", pan([3 * k for k in range(6)]))
    write_video(tmp_path / "one.mp4", pan([2 * k for k in range(6)]))
    assert [s.name for s in open_sources([ClipSource(folder=tmp_path)]).sequences] == ["own", "one.mp4", "clip"]


def test_a_folder_without_one_good_frame_is_named_with_its_first_reason(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", pan([0, 3, 6]))
    (tmp_path / "b").mkdir()
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    with pytest.raises(DatasetError, match=r"none of its 3 frames can be read; first: .*000.png: the image is cut"):
        open_windows([ClipSource(folder=folder)], PLAIN)

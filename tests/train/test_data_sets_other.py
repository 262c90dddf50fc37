"""Hamlyn, C3VD, SimCol3D, EndoSLAM and plain videos: units, axes, crops and what is said of missing files."""

from __future__ import annotations

from pathlib import Path

import cv2
import data_set_trees as trees
import numpy as np
import pytest
from made_videos import write_audio, write_video

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.c3vd import open_c3vd
from bathyscope_train.data.datasets.catalogue import open_data_set, recognise
from bathyscope_train.data.datasets.endoslam import open_endoslam
from bathyscope_train.data.datasets.frame_videos import VideoFrames
from bathyscope_train.data.datasets.hamlyn import hamlyn_splits, open_hamlyn
from bathyscope_train.data.datasets.simcol import open_simcol
from bathyscope_train.data.datasets.videos import open_videos
from bathyscope_train.evaluation.sequences import Crop


def test_hamlyn_is_in_millimetres_with_nought_as_unknown(tmp_path: Path) -> None:
    trees.hamlyn(tmp_path)
    opened = open_hamlyn(tmp_path)
    (sequence,) = opened.sequences
    depth = sequence.truth(2)
    assert depth is not None
    np.testing.assert_array_equal(depth[0], 0)
    np.testing.assert_array_equal(depth[1:], 52)
    assert (sequence.depth_unit, sequence.depth_range) == ("mm", (1e-3, 150.0))
    np.testing.assert_allclose(sequence.intrinsics, trees.K_CORNER)
    assert sum("no such folder" in gap.reason for gap in opened.gaps) == 20


def test_hamlyn_has_21_sequences_and_a_short_list_of_the_last_five() -> None:
    splits = hamlyn_splits()
    assert (len(splits["all"]), splits["short"]) == (21, tuple(f"rectified{n}" for n in range(23, 28)))


@pytest.mark.parametrize(
    ("name", "size", "crop"),
    [
        ("rectified12", (24, 720), None),
        ("rectified14", (24, 720), Crop(0, 24, 180, 590)),
        ("rectified27", (24, 720), Crop(0, 24, 180, 590)),
        ("rectified14", (24, 48), None),
    ],
    ids=["before 14", "14", "27", "too narrow"],
)
def test_the_published_crop_is_columns_180_to_589_after_sequence_13(
    tmp_path: Path, name: str, size: tuple[int, int], crop: Crop | None
) -> None:
    trees.hamlyn(tmp_path, name, frames=2, size=size)
    assert open_hamlyn(tmp_path).sequences[0].published_crop == crop


def test_hamlyn_files_without_a_partner_are_named_and_the_rest_is_paired_by_number(tmp_path: Path) -> None:
    folder = trees.hamlyn(tmp_path)
    (folder / "depth01" / f"{1:010d}.png").unlink()
    (folder / "image01" / f"{2:010d}.jpg").unlink()
    opened = open_hamlyn(tmp_path)
    (sequence,) = opened.sequences
    assert [None if (d := sequence.truth(i)) is None else d[1, 0] for i in range(3)] == [50, None, 53]
    said = {(gap.what, gap.reason) for gap in opened.gaps if gap.what}
    assert said == {(f"{1:010d}", "no depth file of this number"), (f"{2:010d}", "depth without an image")}


def test_c3vd_depth_is_a_share_of_100_mm_and_its_poses_are_transposed(tmp_path: Path) -> None:
    trees.c3vd(tmp_path / "cecum_t1_a")
    (sequence,) = open_c3vd(tmp_path).sequences
    depth = sequence.truth(1)
    assert depth is not None
    np.testing.assert_allclose(depth[1:], trees.plane_depth(1), atol=0.001)
    np.testing.assert_array_equal(depth[0], 0)  # the largest value means 100 mm or more
    assert sequence.world_from_camera is not None
    np.testing.assert_allclose(sequence.world_from_camera[:, :3, 3], [[i, 0, 2 * i] for i in range(4)])


def test_c3vd_intrinsics_follow_the_size_and_the_crop_is_for_the_full_size_alone(tmp_path: Path) -> None:
    trees.c3vd(tmp_path / "small", frames=1)
    folder = tmp_path / "full"
    trees.c3vd(folder, frames=1, size=(1080, 1350))
    full, small = open_c3vd(tmp_path).sequences
    assert full.intrinsics is not None
    assert small.intrinsics is not None
    assert (full.intrinsics[0, 0], full.intrinsics[1, 2]) == (802.319, 547.733)
    assert small.intrinsics[0, 0] == pytest.approx(802.319 * trees.SIZE[1] / 1350)
    assert (full.published_crop, small.published_crop) == (Crop(180, 900, 200, 1150), None)


def test_the_preprocessed_c3vd_has_8_bit_depth(tmp_path: Path) -> None:
    folder = tmp_path / "video"
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True)
    cv2.imwrite(str(folder / "color/0000.png"), trees.picture(0)[..., ::-1])
    cv2.imwrite(str(folder / "depth/0000.png"), np.full(trees.SIZE, 51, np.uint8))
    (folder / "pose.txt").write_text(",".join(map(str, np.eye(4).ravel())))
    depth = open_c3vd(tmp_path).sequences[0].truth(0)
    assert depth is not None
    np.testing.assert_allclose(depth, 20.0, rtol=1e-6)


def test_simcol_depth_is_in_centimetres_and_its_axes_are_turned(tmp_path: Path) -> None:
    trees.simcol(tmp_path)
    opened = open_simcol(tmp_path)
    (sequence,) = opened.sequences
    depth = sequence.truth(0)
    assert depth is not None
    np.testing.assert_allclose(depth, 4.0, rtol=1e-6)
    assert (sequence.depth_unit, sequence.pose_unit) == ("cm", "cm")
    poses = sequence.world_from_camera
    assert poses is not None
    np.testing.assert_allclose(poses[:, :3, 3], [[0.1 * i, -0.2 * i, 0.3 * i] for i in range(4)])
    # turning left-handed by +0.3 about x with y up is turning by -0.3 with y down
    c, s = np.cos(-0.3), np.sin(-0.3)
    np.testing.assert_allclose(poses[3, :3, :3], [[1, 0, 0], [0, c, -s], [0, s, c]], atol=1e-7)
    # cam.txt has the centre where the focal length belongs; it is not read
    np.testing.assert_allclose(
        sequence.intrinsics[:2, :], np.array([[227.60416, 0, 237.5], [0, 227.60416, 237.5]]) / 25
    )


def test_simcol_test_trajectories_are_kept_apart_and_counted(tmp_path: Path) -> None:
    trees.simcol(tmp_path, "S5")
    trees.simcol(tmp_path, "S1")
    trees.simcol(tmp_path, "B10", "SyntheticColon_II")
    assert [s.name for s in open_simcol(tmp_path, "train").sequences] == ["S1"]
    opened = open_simcol(tmp_path, "test")
    assert [s.name for s in opened.sequences] == ["S5", "B10"]
    reasons = {gap.sequence: gap.reason for gap in opened.gaps}
    assert reasons["S5"] == "4 frames, published are 601 (-597)"
    assert reasons["B10"] == "4 frames, published are 1201 (-1197)"
    assert {"S10", "S15", "B5", "B15", "O1", "O2", "O3"} < set(reasons)


def test_endoslam_has_no_true_depth_unless_its_scale_is_stated(tmp_path: Path) -> None:
    trees.endoslam(tmp_path)
    opened = open_endoslam(tmp_path)
    (sequence,) = opened.sequences
    assert sequence.truth(0) is None
    assert any("no true depth" in gap.reason for gap in opened.gaps)
    poses = sequence.world_from_camera
    assert poses is not None
    np.testing.assert_allclose(poses[:, :3, 3], [[i, -2 * i, 3 * i] for i in range(3)])
    assert np.linalg.det(poses[2, :3, :3]) == pytest.approx(1)
    depth = open_endoslam(tmp_path, depth_scale=0.5).sequences[0].truth(1)
    assert depth is not None
    np.testing.assert_allclose(depth, 50.5)


def test_a_folder_tells_which_data_set_it_is(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "a", 1, 1, frames=2)
    trees.hamlyn(tmp_path / "b", frames=1)
    trees.c3vd(tmp_path / "c" / "video", frames=1)
    trees.simcol(tmp_path / "d", frames=1)
    trees.endoslam(tmp_path / "e", frames=1)
    (tmp_path / "f").mkdir()
    kinds = [recognise(tmp_path / name) for name in "abcdef"]
    assert [kind and kind.name for kind in kinds] == ["scared", "hamlyn", "c3vd", "simcol", "endoslam", None]


def test_data_sets_open_by_name_and_refuse_parts_they_do_not_have(tmp_path: Path) -> None:
    trees.simcol(tmp_path, "S5", frames=2)
    assert open_data_set("simcol", tmp_path).name == "simcol"
    with pytest.raises(DatasetError, match="simcol has no split 'val'; known are test, train, all"):
        open_data_set("simcol", tmp_path, split="val")
    with pytest.raises(DatasetError, match="simcol has no keyframes"):
        open_data_set("simcol", tmp_path, frames="keyframes")
    with pytest.raises(DatasetError, match="no such folder"):
        open_data_set("simcol", tmp_path / "nowhere")


def blue(image: np.ndarray) -> int:
    return round((float(image[..., 2].mean()) - 40) / 8)


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mkv", "libx264", "yuv420p"),
        ("a.avi", "libx264", "yuv420p"),
        ("b.avi", "mjpeg", "yuvj420p"),
    ],
)
def test_frames_of_a_video_can_be_read_in_any_order(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    path = write_video(tmp_path / name, [trees.picture(i % 20) for i in range(100)], codec=codec, pixels=pixels)
    video = VideoFrames(path)
    assert (len(video), video.size) == (100, trees.SIZE)
    assert [blue(video.read(i)) for i in (0, 99, 3, 4, 70, 69, 5)] == [i % 20 for i in (0, 99, 3, 4, 70, 69, 5)]


def test_a_damaged_place_in_a_video_is_named_and_the_rest_can_be_read(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", [trees.picture(i) for i in range(12)], codec="mjpeg", pixels="yuvj420p")
    good = VideoFrames(path)
    good.read(11)
    with pytest.raises(DatasetError, match="frame 12 of 12"):
        good.read(12)
    data = bytearray(path.read_bytes())
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    cut = VideoFrames(tmp_path / "cut.avi")
    assert blue(cut.read(2)) == 2
    assert len(cut) < 12


def test_a_folder_of_videos_and_of_frames_is_found_however_deep(tmp_path: Path) -> None:
    write_video(tmp_path / "one.mp4", [trees.picture(i) for i in range(3)])
    frames = tmp_path / "patient" / "clip"
    (frames / "depth").mkdir(parents=True)
    for i in (2, 10, 1):
        cv2.imwrite(str(frames / f"f{i}.png"), trees.picture(i)[..., ::-1])
        cv2.imwrite(str(frames / "depth" / f"f{i}.png"), np.zeros(trees.SIZE, np.uint16))
    found = {s.name: s for s in open_videos(tmp_path).sequences}
    assert sorted(found) == ["one.mp4", "patient/clip"]
    assert [blue(image) for image in found["patient/clip"].images()] == [1, 2, 10]
    assert found["one.mp4"].truth(0) is None


def test_files_that_cannot_be_used_are_named_and_the_rest_is(tmp_path: Path) -> None:
    write_video(tmp_path / "good.mp4", [trees.picture(i) for i in range(3)])
    write_video(tmp_path / "single.mp4", [trees.picture(0)])
    write_audio(tmp_path / "sound.mp4")
    (tmp_path / "junk.mp4").write_bytes(b"no video at all" * 10)
    found = open_videos(tmp_path)
    assert [sequence.name for sequence in found.sequences] == ["good.mp4"]
    reasons = {gap.sequence: gap.reason for gap in found.gaps}
    assert "1 frame; a clip to train on needs at least 2" in reasons["single.mp4"]
    assert "no video stream (audio only)" in reasons["sound.mp4"]
    assert "junk.mp4: not a video that can be read" in reasons["junk.mp4"]


def test_a_folder_with_nothing_to_train_on_says_why(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"nothing to train on: no video files"):
        open_videos(tmp_path)
    with pytest.raises(DatasetError, match="no such file or folder"):
        open_videos(tmp_path / "nowhere")


def test_a_frame_of_another_size_and_one_cut_short_are_named(tmp_path: Path) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), trees.picture(i)[..., ::-1])
    cv2.imwrite(str(tmp_path / "1.jpg"), trees.picture(1, (16, 24))[..., ::-1])
    whole = (tmp_path / "2.jpg").read_bytes()
    (tmp_path / "2.jpg").write_bytes(whole[: len(whole) // 2])
    (sequence,) = open_videos(tmp_path).sequences
    with pytest.raises(DatasetError, match=r"1.jpg: 24x16 pixels, the other frames of .* have 48x32"):
        sequence.image(1)
    with pytest.raises(DatasetError, match=r"2.jpg: the image is cut short"):
        sequence.image(2)
    assert blue(sequence.image(3)) == 3

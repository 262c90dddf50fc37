"""SCARED: every tree in use, and each way in which reading it goes wrong."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import cv2
import data_set_trees as trees
import numpy as np
import pytest

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.scared import open_scared
from bathyscope_train.data.datasets.scared_frame_data import read_frame_data
from bathyscope_train.data.datasets.scared_sequence import open_keyframe, open_sequence
from bathyscope_train.data.datasets.scared_splits import frame_counts, scared_split, scared_splits
from bathyscope_train.data.datasets.scared_tree import find_scared, is_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.sequences import EvaluationSequence


def number_of(image: np.ndarray) -> int:
    """Which frame a picture shows, from its blue."""
    return round((float(image[..., 2].mean()) - 40) / 8)


def only(root: Path) -> DataSequence:
    """The one sequence of a tree."""
    (folder,) = find_scared(root).values()
    return open_sequence(folder).sequence


def check_plane(sequence: DataSequence, frames: int = 5) -> None:
    """Frames, depth, poses and camera are those of the generator."""
    assert (len(sequence), sequence.size) == (frames, trees.SIZE)
    for index in range(frames):
        assert number_of(sequence.image(index)) == index
        depth = sequence.truth(index)
        assert depth is not None
        assert depth.shape == trees.SIZE
        np.testing.assert_array_equal(depth[:, 0], 0)
        np.testing.assert_allclose(depth[:, 1:], trees.plane_depth(index), rtol=1e-6)


def test_the_published_counts_of_every_split_add_up() -> None:
    counts = frame_counts()
    total = {
        name: (len(split.frames), sum(counts[s] if f is None else len(f) for s, f in split.frames.items()))
        for name, split in scared_splits().items()
    }
    assert total == {
        "video-train": (24, 21_898),
        "video-val": (3, 1_052),
        "video-test": (8, 5_907),
        "endovis-test": (7, 551),
        "without-4-5-train": (19, 17_206),
        "all": (35, 28_857),
    }


def test_the_parts_of_the_video_split_do_not_overlap_and_the_endovis_test_trains_it() -> None:
    parts = [set(scared_split(f"video-{part}").frames) for part in ("train", "val", "test")]
    assert len(set.union(*parts)) == 35
    assert set(scared_split("endovis-test").frames) < parts[0]


def test_the_official_tree_gives_the_left_eye_its_depth_and_its_poses(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 2)
    sequence: EvaluationSequence = only(tmp_path)
    assert isinstance(sequence, DataSequence)
    check_plane(sequence)
    assert sequence.name == "dataset1/keyframe2"
    assert (sequence.depth_unit, sequence.pose_unit, sequence.depth_range) == ("mm", "mm", (1e-3, 150.0))
    # camera-pose maps the world to the camera; cameras stand at (index, 0, 2 index)
    assert sequence.world_from_camera is not None
    np.testing.assert_allclose(sequence.world_from_camera[:, :3, 3], [[i, 0, 2 * i] for i in range(5)])
    # OpenCV's principal point counts from the centre of the first pixel
    np.testing.assert_allclose(sequence.intrinsics, trees.K_CORNER)


@pytest.mark.parametrize("kind", ["tiff", "npy"])
@pytest.mark.parametrize(("first", "name"), [(0, "frame_data{:06d}.png"), (1, "{}.jpg.png"), (7, "{:05d}.png")])
def test_unpacked_trees_pair_images_with_points_whatever_number_they_begin_at(
    tmp_path: Path, first: int, name: str, kind: str
) -> None:
    folder = tmp_path / "train" / "dataset3" / "keyframe4"
    trees.scared_left_images(folder, first=first, image_name=name.replace(".jpg", ""), kind=kind)
    sequence = only(tmp_path)
    check_plane(sequence)
    assert list(sequence.frame_names) == [f"{i:06d}" for i in range(5)]
    assert sequence.world_from_camera is not None
    np.testing.assert_allclose(sequence.world_from_camera[:, 0, 3], range(5))


@pytest.mark.parametrize("stacked", [False, True], ids=["cropped", "both eyes"])
def test_images_of_the_af_tree_count_from_one_and_its_points_from_nought(tmp_path: Path, stacked: bool) -> None:
    trees.scared_af(tmp_path / "dataset3" / "keyframe4", stacked=stacked)
    check_plane(only(tmp_path))


def test_test_keyframes_of_the_af_tree_get_their_own_numbers_back(tmp_path: Path) -> None:
    for keyframe in (1, 2):
        trees.scared_af(tmp_path / "dataset8" / f"keyframe{keyframe}", frames=2)
    assert list(find_scared(tmp_path)) == ["dataset8/keyframe0", "dataset8/keyframe1"]


def test_test_keyframes_that_count_from_nought_keep_their_numbers(tmp_path: Path) -> None:
    for keyframe in (0, 1):
        trees.scared_left_images(tmp_path / "test" / "dataset8" / f"keyframe{keyframe}", frames=2)
    assert list(find_scared(tmp_path)) == ["dataset8/keyframe0", "dataset8/keyframe1"]


def test_lengths_tell_how_test_keyframes_are_numbered(tmp_path: Path) -> None:
    # dataset9/keyframe3 has 309 frames; here it is called keyframe4
    folder = tmp_path / "test" / "dataset9" / "keyframe4" / "data" / "left"
    folder.mkdir(parents=True)
    (data,) = [cv2.imencode(".png", trees.picture(0, (4, 6)))[1].tobytes()]
    for index in range(309):
        (folder / f"{index}.png").write_bytes(data)
    assert list(find_scared(tmp_path)) == ["dataset9/keyframe3"]


def test_depth_maps_of_the_toolkit_are_in_128ths_of_a_millimetre(tmp_path: Path) -> None:
    folder = tmp_path / "dataset_1" / "keyframe_1" / "data"
    for part in ("left", "depthmap"):
        (folder / part).mkdir(parents=True)
    for i in range(3):
        cv2.imwrite(str(folder / "left" / f"{i:06d}.png"), trees.picture(i)[..., ::-1])
        cv2.imwrite(str(folder / "depthmap" / f"{i:06d}.png"), np.full(trees.SIZE, 128 * 50 + 64, np.uint16))
    depth = only(tmp_path).truth(1)
    assert depth is not None
    np.testing.assert_allclose(depth, 50.5)


def test_the_keyframe_is_read_as_it_was_measured_with_nan_as_unknown(tmp_path: Path) -> None:
    folder = trees.scared_official(tmp_path, 2, 5)
    still = open_keyframe(find_scared(tmp_path)["dataset2/keyframe5"])
    assert still is not None
    depth = still.truth(0)
    assert depth is not None
    np.testing.assert_array_equal(depth[:, 0], 0)
    np.testing.assert_allclose(depth[:, 1:], trees.plane_depth(0))
    np.testing.assert_allclose(still.intrinsics, trees.K_CORNER)
    assert folder.name == "keyframe_5"


def test_datasets_4_and_5_are_flagged_and_others_are_not(tmp_path: Path) -> None:
    for dataset in (3, 4, 5):
        trees.scared_official(tmp_path, dataset, 1, frames=2)
    opened = open_scared(tmp_path, "all")
    flagged = {s.name for s in opened.sequences if any("known to be wrong" in note for note in s.notes)}
    assert flagged == {"dataset4/keyframe1", "dataset5/keyframe1"}


def test_a_split_says_what_is_missing_and_what_has_another_length(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 8, 0)
    opened = open_scared(tmp_path, "video-test")
    assert [sequence.name for sequence in opened.sequences] == ["dataset8/keyframe0"]
    reasons = {gap.sequence: gap.reason for gap in opened.gaps}
    assert len(reasons) == 8
    assert reasons["dataset8/keyframe0"] == "5 frames, published are 945 (-940)"
    assert "no such folder" in reasons["dataset9/keyframe3"]


def test_lists_of_frames_count_from_one_and_missing_frames_are_named(tmp_path: Path) -> None:
    wanted = scared_split("endovis-test").frames["dataset3/keyframe4"]
    assert wanted is not None
    assert {389, 179} < set(wanted)  # lines `dataset3/keyframe4 390 l` and `180`
    trees.scared_left_images(tmp_path / "train" / "dataset3" / "keyframe4", frames=wanted[1] + 1)
    opened = open_scared(tmp_path, "endovis-test")
    (sequence,) = opened.sequences
    assert list(sequence.frame_names) == [f"{number:06d}" for number in wanted[:2]]
    depth = sequence.truth(1)
    assert depth is not None
    assert depth[0, 5] == pytest.approx(trees.plane_depth(wanted[1]))
    assert sum(gap.sequence == "dataset3/keyframe4" for gap in opened.gaps) == len(wanted) - 2


def test_frames_and_depth_that_do_not_match_are_paired_by_number_and_counted(tmp_path: Path) -> None:
    folder = trees.scared_left_images(tmp_path / "dataset1" / "keyframe1")
    (folder / "data/left/frame_data000003.png").unlink()
    (folder / "data/scene_points/scene_points000001.tiff").unlink()
    opened = open_sequence(find_scared(tmp_path)["dataset1/keyframe1"])
    assert list(opened.sequence.frame_names) == ["000000", "000001", "000002", "000004"]
    assert opened.sequence.truth(1) is None
    depth = opened.sequence.truth(3)
    assert depth is not None
    assert depth[0, 5] == pytest.approx(trees.plane_depth(4))
    assert opened.problems == ("1 frames have no depth file, first 000001", "1 depth files have no frame, first 000003")


def test_trees_without_depth_are_read_and_said(tmp_path: Path) -> None:
    folder = trees.scared_official(tmp_path, 8, 1)
    (folder / "data/scene_points.tar.gz").unlink()
    opened = open_sequence(find_scared(tmp_path)["dataset8/keyframe1"])
    assert opened.sequence.truth(0) is None
    assert any("no true depth" in problem for problem in opened.problems)


def test_archives_are_read_forwards_and_gaps_are_frames_without_depth(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 1, depth_of=[0, 2, 4])
    sequence = only(tmp_path)
    found = [sequence.truth(index) for index in (0, 1, 2, 2, 3, 4)]
    assert [None if depth is None else round(float(depth[0, 5])) for depth in found] == [60, None, 56, 56, None, 52]


def test_an_archive_out_of_order_sends_the_user_to_prepare(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 1, depth_of=[0, 3, 1])
    sequence = only(tmp_path)
    with pytest.raises(DatasetError, match=r"scene_points.tar.gz: its members are not in order.*data prepare scared"):
        sequence.truth(4)


def test_a_damaged_archive_is_named(tmp_path: Path) -> None:
    folder = trees.scared_official(tmp_path, 1, 1)
    archive = folder / "data/frame_data.tar.gz"
    archive.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(DatasetError, match=r"frame_data.tar.gz: the archive is damaged"):
        only(tmp_path)


def test_a_broken_json_among_good_ones_is_named_and_its_frame_has_no_pose(tmp_path: Path) -> None:
    folder = trees.scared_left_images(tmp_path / "dataset1" / "keyframe1")
    broken = folder / "data/frame_data/frame_data000002.json"
    broken.write_text(json.dumps({"camera-pose": (2 * np.eye(4)).tolist()}))
    poses, problems = read_frame_data(broken.parent)
    assert sorted(poses) == [0, 1, 3, 4]
    assert "frame_data000002.json: its camera-pose is no rigid 4x4 matrix" in problems[0]
    sequence = only(tmp_path)
    assert sequence.world_from_camera is not None
    assert np.isnan(sequence.world_from_camera[2]).all()


def test_keyframes_alone_are_the_measured_stills_or_first_frames(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 8, 0)
    trees.scared_left_images(tmp_path / "test" / "dataset9" / "keyframe0", frames=3)
    opened = open_scared(tmp_path, "video-test", frames="keyframes")
    assert [(s.name, list(s.frame_names)) for s in opened.sequences] == [
        ("dataset8/keyframe0", ["keyframe"]),
        ("dataset9/keyframe0", ["000000"]),
    ]


def overlay(root: Path, frames: tuple[int, ...] = (1, 2)) -> Path:
    """Corrections that put cameras at (10 index, 0, 0) and depth 3 mm nearer."""
    folder = root / "dataset8" / "keyframe0"
    (folder / "depth").mkdir(parents=True)
    lines = []
    for i in frames:
        pose = np.eye(4)
        pose[0, 3] = 10 * i
        lines.append(" ".join([f"{i:06d}.png", *map(str, pose.ravel())]))
        values = np.full(trees.SIZE, 10 * (trees.plane_depth(i) - 3), np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), values)
    (folder / "poses.txt").write_text("\n".join(lines))
    camera = {"width": 48, "height": 32, "fx": 40, "fy": 40, "cx": 24, "cy": 16, "depth_scale": 0.1}
    (folder / "intrinsics.json").write_text(json.dumps(camera))
    return root


def test_corrections_lie_over_the_tree_and_form_a_group(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "scared", 8, 0)
    opened = open_scared(tmp_path / "scared", corrected=overlay(tmp_path / "corrected"))
    (sequence,) = opened.sequences
    np.testing.assert_array_equal(sequence.groups["corrected"], [False, True, True, False, False])
    np.testing.assert_array_equal(sequence.groups["keyframes"], [True, False, False, False, False])
    depth = [sequence.truth(index) for index in range(4)]
    assert [round(float(d[0, 5])) for d in depth if d is not None] == [60, 55, 53, 54]
    poses = sequence.world_from_camera
    assert poses is not None
    np.testing.assert_array_equal(poses[1:3, 0, 3], [10, 20])
    assert np.isnan(poses[[0, 3, 4]]).all()  # official poses live in another world


def test_corrected_frames_can_be_taken_alone(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "scared", 8, 0)
    chosen = open_scared(tmp_path / "scared", frames="corrected", corrected=overlay(tmp_path / "corrected"))
    assert list(chosen.sequences[0].frame_names) == ["000001", "000002"]
    with pytest.raises(DatasetError, match="no folder of SCARED-C"):
        open_scared(tmp_path / "scared", frames="corrected")


def test_sequences_travel_to_other_processes(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 1)
    sequence = only(tmp_path)
    sequence.image(3), sequence.truth(2)
    check_plane(pickle.loads(pickle.dumps(sequence)))


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ("video-test", r"nothing of the video split.*dataset8/keyframe0"),
        ("test", "no split 'test'; known are video-train"),
    ],
)
def test_a_split_that_is_not_there_is_refused(tmp_path: Path, split: str, message: str) -> None:
    trees.scared_official(tmp_path, 1, 1, frames=2)
    with pytest.raises(DatasetError, match=message):
        open_scared(tmp_path, split)


def test_a_folder_without_the_tree_says_what_was_expected(tmp_path: Path) -> None:
    assert not is_scared(tmp_path)
    with pytest.raises(DatasetError, match=r"no SCARED here; expected dataset_1/keyframe_1/data/rgb.mp4"):
        find_scared(tmp_path)


def test_a_sequence_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 1, frames=2)
    trees.scared_left_images(tmp_path / "train" / "dataset1" / "keyframe1", frames=2)
    with pytest.raises(DatasetError, match="dataset1/keyframe1 is in both"):
        find_scared(tmp_path)

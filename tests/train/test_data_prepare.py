"""``bathyscope data prepare scared`` and ``bathyscope data check``."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import data_set_trees as trees
import numpy as np
import pytest
from made_videos import write_video
from typer.testing import CliRunner

from bathyscope.camera import invert_pose
from bathyscope.errors import DatasetError, SettingsError
from bathyscope_train.data.cli import app
from bathyscope_train.data.datasets.check import CheckReport, check_data
from bathyscope_train.data.datasets.pose_agreement import pose_agreement
from bathyscope_train.data.datasets.prepare_scared import prepare_scared
from bathyscope_train.data.datasets.prepared_files import DEPTH_SCALE_MM
from bathyscope_train.data.datasets.scared import open_scared
from bathyscope_train.data.datasets.scared_sequence import open_sequence
from bathyscope_train.data.datasets.scared_tree import find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.folders import DatasetFolder


def official(root: Path) -> DataSequence:
    (folder,) = find_scared(root).values()
    return open_sequence(folder).sequence


def test_archives_become_folders_with_the_same_frames_depth_poses_and_camera(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 1, 2)
    prepare_scared(tmp_path / "in", tmp_path / "out", workers=1)
    folder = DatasetFolder.open(tmp_path / "out/sequences/dataset1_keyframe2")
    source = official(tmp_path / "in")
    assert len(folder.frames) == 5
    for index in range(5):
        np.testing.assert_array_equal(folder.image(index), source.image(index))
        known = folder.truth.at(index)
        assert len(known.depth) == (trees.SIZE[1] - 1) * trees.SIZE[0]
        np.testing.assert_allclose(known.depth, trees.plane_depth(index), atol=DEPTH_SCALE_MM / 2)
    np.testing.assert_allclose(folder.world_from_camera, source.world_from_camera)
    np.testing.assert_allclose(folder.calibration.matrix, trees.K_CORNER)
    assert (folder.calibration.depth_unit, folder.calibration.pose_unit) == ("mm", "mm")


def test_a_prepared_tree_is_read_as_scared_with_splits_groups_and_measured_keyframes(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 8, 0)
    prepare_scared(tmp_path / "in", tmp_path / "out")
    (sequence,) = open_scared(tmp_path / "out", "video-test").sequences
    assert (sequence.name, len(sequence.frame_names)) == ("dataset8/keyframe0", 5)
    np.testing.assert_array_equal(sequence.groups["keyframes"], [True, False, False, False, False])
    depth = sequence.truth(3)
    assert depth is not None
    np.testing.assert_allclose(depth[:, 1:], trees.plane_depth(3), atol=DEPTH_SCALE_MM / 2)
    (still,) = open_scared(tmp_path / "out", "video-test", frames="keyframes").sequences
    assert list(still.frame_names) == ["keyframe"]


def test_a_run_that_was_interrupted_writes_what_is_missing_alone(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 1, 1)
    out = tmp_path / "out"
    first = prepare_scared(tmp_path / "in", out)
    made = next(entry for entry in first if entry.name == "dataset1/keyframe1")
    assert (made.frames, made.depth, made.new) == (5, 5, 12)  # and the keyframe's two
    target = out / "sequences/dataset1_keyframe1"
    for path in ("intrinsics.json", "frames/000003.png", "depth/000004.png"):
        (target / path).unlink()
    kept = (target / "frames/000001.png").stat().st_mtime_ns
    again = next(entry for entry in prepare_scared(tmp_path / "in", out) if entry.name == "dataset1/keyframe1")
    assert (again.frames, again.depth, again.new) == (5, 5, 2)
    assert (target / "frames/000001.png").stat().st_mtime_ns == kept
    assert prepare_scared(tmp_path / "in", out)[0].new == 0
    assert not list(out.rglob(".*"))


def test_depth_may_come_in_any_order_and_out_of_range_is_counted(tmp_path: Path) -> None:
    folder = trees.scared_official(tmp_path / "in", 1, 1, frames=3)
    far = trees.points(1)
    far[5, 7, 2] = 300.0
    both = [np.concatenate([part, part]) for part in (trees.points(2), far, trees.points(0))]
    names = [f"scene_points{i:06d}.tiff" for i in (2, 1, 0)]
    trees.write_tar(folder / "data/scene_points.tar.gz", zip(names, map(trees.float_tiff, both), strict=True))
    (entry,) = (e for e in prepare_scared(tmp_path / "in", tmp_path / "out") if e.name == "dataset1/keyframe1")
    assert "1 pixels farther than 256 mm; written as unknown" in entry.said
    values = cv2.imread(str(tmp_path / "out/sequences/dataset1_keyframe1/depth/000001.png"), cv2.IMREAD_UNCHANGED)
    assert (values[5, 7], values[5, 8]) == (0, round(trees.plane_depth(1) / DEPTH_SCALE_MM))


def test_what_is_missing_is_said_for_each_sequence_and_the_rest_goes_on(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 1, 1, depth_of=[0, 1, 2])
    trees.scared_still(tmp_path / "in" / "dataset_2" / "keyframe_5")
    broken = trees.scared_official(tmp_path / "in", 4, 1) / "data/scene_points.tar.gz"
    broken.write_bytes(broken.read_bytes()[:-300])
    entries = {entry.name: entry for entry in prepare_scared(tmp_path / "in", tmp_path / "out")}
    assert len(entries) == 36  # 35 published sequences and the single keyframe
    assert entries["dataset7/keyframe1"].said == ["missing"]
    assert "5 frames, published are 197 (-192)" in entries["dataset1/keyframe1"].said
    assert "2 frames without depth" in entries["dataset1/keyframe1"].said
    assert entries["dataset2/keyframe5"].complete
    assert any("scene_points.tar.gz: the archive is damaged" in said for said in entries["dataset4/keyframe1"].said)
    assert not (tmp_path / "out/sequences/dataset4_keyframe1/intrinsics.json").exists()


def test_a_sequence_without_calibration_gets_the_mean_one_and_says_so(tmp_path: Path) -> None:
    folder = trees.scared_official(tmp_path / "in", 1, 1, frames=2, still=False)
    (folder / "data/frame_data.tar.gz").unlink()
    (entry,) = (e for e in prepare_scared(tmp_path / "in", tmp_path / "out") if e.name == "dataset1/keyframe1")
    assert any("the mean of all is written" in said for said in entry.said)
    values = json.loads((tmp_path / "out/sequences/dataset1_keyframe1/intrinsics.json").read_text())
    assert (values["fx"], values["cy"]) == (pytest.approx(0.82 * trees.SIZE[1]), pytest.approx(0.5 * trees.SIZE[0]))


def test_settings_cannot_change_on_the_way(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 1, 1, frames=2)
    prepare_scared(tmp_path / "in", tmp_path / "out")
    with pytest.raises(SettingsError, match="begun with other settings"):
        prepare_scared(tmp_path / "in", tmp_path / "out", jpeg_quality=95)


def test_the_command_prints_what_is_missing_and_fails(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "in", 1, 1, frames=2)
    result = CliRunner().invoke(app, ["prepare", "scared", str(tmp_path / "in"), str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "dataset1/keyframe1: 2 frames, 2 depth maps, 6 files written" in result.output
    assert "dataset9/keyframe3: 0 frames" in result.output
    assert "0 of 35 sequences complete" in result.output


def test_poses_and_depth_agree_as_they_are_read_and_not_the_other_way_round(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 1, 1)
    sequence = official(tmp_path)
    found = pose_agreement(sequence)
    assert found is not None
    assert (found.frames, found.tells, found.wrong_way) == ((0, 4), True, False)
    assert found.as_read < 1e-5
    # the camera comes 8 mm closer to a wall at 60 mm; the other way round it would be 16 mm off at 52
    assert found.turned_round == pytest.approx(16 / 52, rel=1e-4)
    assert found.standing_still == pytest.approx(8 / 52, rel=1e-4)


def report(root: Path, **options: bool) -> tuple[CheckReport, str]:
    found = check_data(root, **options)  # type: ignore[arg-type]
    return found, "\n".join(f"{f.level}: {f.where}: {f.what}" for f in found.findings)


def test_check_counts_scared_and_tells_its_pitfalls(tmp_path: Path) -> None:
    trees.scared_official(tmp_path, 5, 4)
    trees.scared_official(tmp_path, 8, 0)
    (tmp_path / "dataset_8/keyframe_0/data/scene_points.tar.gz").unlink()
    found, text = report(tmp_path)
    assert (found.kind, [s.name for s in found.sequences]) == ("scared", ["dataset5/keyframe4", "dataset8/keyframe0"])
    assert found.sequences[0].depth_coverage == pytest.approx(47 / 48)
    assert (found.sequences[0].poses, found.complete) == (5, False)
    for words in (
        "missing: dataset1/keyframe1: not there; published are 197 frames",
        "missing: dataset5/keyframe4: 5 frames, published are 411 (-406)",
        "only keyframes were measured",
        "calibration of data set 5 is wrong",
        "swap training and test",
        "test sequences without true depth (a copy without data/ circulates): dataset8/keyframe0",
        "depth is read from archives",
        "focal lengths are 1.02 to 1.29 times",
        "note: dataset5/keyframe4: depth carried from frame 0 to 4 differs by 0.0%",
    ):
        assert words in text


def test_check_finds_inverted_poses(tmp_path: Path) -> None:
    folder = trees.scared_left_images(tmp_path / "dataset1" / "keyframe1")
    for path in (folder / "data/frame_data").iterdir():
        values = json.loads(path.read_text())
        values["camera-pose"] = invert_pose(np.array(values["camera-pose"])).tolist()
        path.write_text(json.dumps(values))
    assert "the poses look inverted" in report(tmp_path)[1]


def test_check_tells_the_pitfalls_of_the_other_sets(tmp_path: Path) -> None:
    hamlyn = tmp_path / "hamlyn"
    trees.hamlyn(hamlyn, "rectified14", frames=2)
    for name in ("color", "depth"):
        (hamlyn / "tracking" / name).mkdir(parents=True)
    for i in (9, 10):
        (hamlyn / "rectified14/depth01" / f"{i}.png").write_bytes(
            (hamlyn / "rectified14/depth01" / f"{0:010d}.png").read_bytes()
        )
    text = report(hamlyn)[1]
    assert "depth is stereo matching" in text
    assert "crop 1 sequences to columns 180 to 589" in text
    assert "pitfall: rectified14: names are not padded with zeros" in text
    assert "tracking: tracking test data" in text
    assert "missing: rectified14 9: depth without an image" in text
    trees.c3vd(tmp_path / "c3vd" / "video", frames=2)
    assert "1 videos, 2 frames; the whole set has 22 and 10015" in report(tmp_path / "c3vd")[1]
    trees.simcol(tmp_path / "simcol", frames=2)
    text = report(tmp_path / "simcol")[1]
    assert "cam.txt is not read" in text
    assert "test trajectories" in text
    trees.endoslam(tmp_path / "endoslam")
    assert "not used as ground truth" in report(tmp_path / "endoslam")[1]


def test_check_names_damaged_files_and_frames_without_depth(tmp_path: Path) -> None:
    folder = trees.hamlyn(tmp_path, frames=5)
    cv2.imwrite(str(folder / "depth01" / f"{1:010d}.png"), np.zeros(trees.SIZE, np.uint16))
    (folder / "depth01" / f"{3:010d}.png").write_bytes(b"damaged")
    (folder / "image01" / f"{3:010d}.jpg").write_bytes(b"damaged")
    found, text = report(tmp_path, every_frame=True)
    assert found.sequences[0].looked_at == 5
    assert "1 of 4 frames looked at have depth files without one usable pixel" in text
    assert text.count("unreadable: rectified04") == 2


def test_check_of_videos_says_what_training_would_use(tmp_path: Path) -> None:
    write_video(tmp_path / "good.mp4", [trees.picture(0)] * 5)
    write_video(tmp_path / "single.mp4", [trees.picture(0)])
    found, text = report(tmp_path, every_frame=True)
    assert (found.kind, [s.frames for s in found.sequences]) == ("videos", [5])
    assert "single.mp4: 1 frame" in text
    assert "good.mp4: 1 frames in which the camera moves, in 1 shot" in text
    assert "4 frames show nothing new" in text


def test_the_command_prints_a_report_or_json_and_fails_where_something_is_missing(tmp_path: Path) -> None:
    trees.c3vd(tmp_path / "video", frames=2)
    good = CliRunner().invoke(app, ["check", str(tmp_path), "--json"])
    assert (good.exit_code, json.loads(good.stdout)["kind"]) == (0, "c3vd")
    (tmp_path / "video/0001_depth.tiff").unlink()
    bad = CliRunner().invoke(app, ["check", str(tmp_path)])
    assert bad.exit_code == 1
    assert "missing: video 0001: no depth file of this number" in bad.stdout


def test_a_folder_that_is_not_there_or_empty_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        check_data(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="nothing to train on"):
        check_data(tmp_path)
    with pytest.raises(DatasetError, match="no data set 'kitti'; known are scared"):
        check_data(tmp_path, kind="kitti")

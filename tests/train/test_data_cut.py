"""A part of a data set folder is measured as the same frames of the whole."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.cut import cut_folder
from bathyscope_train.evaluation.folders import DatasetFolder

SIZE = (20, 30)


@pytest.fixture(name="folder")
def _folder(tmp_path: Path) -> Path:
    """Six frames of one grey each, with points and poses."""
    folder = tmp_path / "whole"
    (folder / "frames").mkdir(parents=True)
    poses = ["# frame, camera to world"]
    for index in range(6):
        cv2.imwrite(str(folder / "frames" / f"{index:04d}.png"), np.full((*SIZE, 3), 10 * index, np.uint8))
        pose = np.eye(4)
        pose[0, 3] = index
        poses.append(f"{index:04d}.png " + " ".join(str(value) for value in pose.ravel()))
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    stated = {"width": 30, "height": 20, "fx": 20.0, "fy": 20.0, "cx": 15.0, "cy": 10.0}
    (folder / "intrinsics.json").write_text(json.dumps({**stated, "source_frame_indices": list(range(100, 106))}))
    frames = np.repeat(np.arange(6, dtype=np.int32), 3)
    np.savez(
        folder / "sparse.npz",
        points_xyz=np.zeros((3, 3), np.float32),
        obs_point=np.tile(np.arange(3, dtype=np.int32), 6),
        obs_frame=frames,
        obs_uv=np.tile(np.array([[5, 5], [9, 9], [20, 15]], np.float32), (6, 1)),
        obs_depth=(1 + frames).astype(np.float32),
        obs_flow_err_px=np.zeros(18, np.float32),
    )
    return folder


def test_a_cut_folder_holds_the_same_truth_for_its_frames(folder: Path, tmp_path: Path) -> None:
    assert cut_folder(folder, tmp_path / "late", start=2, stop=5) == 3
    whole, late = DatasetFolder.open(folder), DatasetFolder.open(tmp_path / "late")
    assert [path.name for path in late.frames] == ["0002.png", "0003.png", "0004.png"]
    for index in range(3):
        mine, theirs = late.truth.at(index), whole.truth.at(index + 2)
        assert (mine.depth == theirs.depth).all()
        assert list(zip(mine.rows, mine.columns, strict=True)) == list(zip(theirs.rows, theirs.columns, strict=True))
        assert len(mine.depth) == 3
    assert [pose[0, 3] for pose in late.world_from_camera] == [2, 3, 4]
    assert json.loads((tmp_path / "late" / "intrinsics.json").read_text())["source_frame_indices"] == [102, 103, 104]


def test_frames_only_leaves_out_what_training_must_not_see(folder: Path, tmp_path: Path) -> None:
    cut_folder(folder, tmp_path / "early", stop=2, frames_only=True)
    found = sorted(path.relative_to(tmp_path / "early").as_posix() for path in (tmp_path / "early").rglob("*.*"))
    assert found == ["frames/0000.png", "frames/0001.png", "intrinsics.json"]


def test_a_range_without_frames_and_a_folder_that_exists_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="has 6 frames in frames/, none from 6 to the end; give a range inside it"):
        cut_folder(folder, tmp_path / "none", start=6)
    with pytest.raises(DatasetError, match="whole: exists"):
        cut_folder(folder, folder)

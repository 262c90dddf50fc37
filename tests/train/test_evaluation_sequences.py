"""Sequences as an evaluation sees them: folders, crops, the identity of a split; and predictions on disk."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_sequences import MadeSequence

from bathyscope.clip import FrameSequence
from bathyscope.errors import DatasetError, ResultError
from bathyscope_train.evaluation.estimates import open_estimates, store_estimates
from bathyscope_train.evaluation.folder_sequences import known_unit, open_folders
from bathyscope_train.evaluation.sequence_views import SequenceView
from bathyscope_train.evaluation.sequences import Crop, EvaluationSet
from bathyscope_train.systems.system import FrameEstimate, SystemInfo

H, W, T = 6, 8, 3
METRES = SystemInfo(name="made", quantity="depth", scale="metric", unit="m")


def estimates(size: tuple[int, int] = (H, W), count: int = T) -> Iterator[FrameEstimate]:
    for index in range(count):
        valid = np.ones(size, np.bool_)
        valid[index] = False
        yield FrameEstimate(index, np.full(size, 1.0 + index, np.float32), valid, world_from_camera=np.eye(4))


def store(folder: Path, key: str = "a", **options: int) -> int:
    return len(list(store_estimates(folder, key, METRES, (T, H, W), estimates(**options))))


def test_predictions_come_back_from_disk_as_they_went_in(tmp_path: Path) -> None:
    assert store(tmp_path / "p") == T
    found = open_estimates(tmp_path / "p", "a")
    assert found is not None
    frame = found.read(2)
    assert (frame.values == 3).all()
    assert np.flatnonzero(~frame.valid.all(axis=1)).tolist() == [2]
    assert frame.millimetres == 1000.0
    assert found.world_from_camera is not None
    assert found.world_from_camera.shape == (T, 4, 4)
    assert found.intrinsics is None


def test_predictions_of_something_else_or_unfinished_are_not_used(tmp_path: Path) -> None:
    assert open_estimates(tmp_path / "p", "a") is None
    store(tmp_path / "p")
    assert open_estimates(tmp_path / "p", "b") is None
    writing = store_estimates(tmp_path / "p", "a", METRES, (T, H, W), estimates())
    next(writing)
    writing.close()
    assert open_estimates(tmp_path / "p", "a") is None


def test_predictions_that_were_cut_short_on_disk_are_refused(tmp_path: Path) -> None:
    store(tmp_path / "p")
    values = tmp_path / "p" / "values.f32"
    values.write_bytes(values.read_bytes()[:-4])
    with pytest.raises(ResultError, match=f"{4 * (T * H * W - 1)} bytes, {4 * T * H * W} belong there"):
        open_estimates(tmp_path / "p", "a")


def test_a_system_that_loses_frames_or_changes_their_size_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="3 frames went in, 2 came back"):
        store(tmp_path / "p", count=2)
    with pytest.raises(DatasetError, match=r"frame 0 of size \(6, 9\)"):
        list(store_estimates(tmp_path / "p", "a", METRES, (T, H, W), estimates((H, W + 1))))


def test_the_split_hash_names_the_frames_and_nothing_else() -> None:
    first, other = MadeSequence(np.ones((2, H, W))), MadeSequence(np.full((2, H, W), 5.0))
    longer = MadeSequence(np.ones((3, H, W)))
    hashes = [EvaluationSet("set", (sequence,), "words").split_hash for sequence in (first, other, longer)]
    assert hashes[0] == hashes[1] != hashes[2]
    assert len(hashes[0]) == 12


def test_a_crop_takes_image_truth_and_camera_along() -> None:
    depth = np.arange(T * H * W, dtype=float).reshape(T, H, W) + 1
    k = np.array([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]])
    view = SequenceView(MadeSequence(depth, intrinsics=k), Crop(1, 5, 2, 8), limit=2)
    assert isinstance(view, FrameSequence)
    assert (len(view), view.size, view.image(0).shape) == (2, (4, 6), (4, 6, 3))
    truth, cropped = view.truth(1), view.intrinsics
    assert truth is not None
    assert (truth == depth[1, 1:5, 2:8]).all()
    assert cropped is not None
    assert cropped[:2, 2].tolist() == [2.0, 2.0]


def test_of_several_points_in_one_pixel_the_nearest_is_the_truth(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "0.png"), np.zeros((H, W, 3), np.uint8))
    calibration = {"width": W, "height": H, "fx": 9, "fy": 9, "cx": 4, "cy": 3, "pose_unit": "arbitrary"}
    (tmp_path / "intrinsics.json").write_text(json.dumps(calibration))
    points = {"obs_frame": [0, 0, 0], "obs_uv": [[2.2, 3.9], [2.7, 3.1], [5.0, 0.0]], "obs_depth": [9.0, 4.0, 7.0]}
    np.savez(tmp_path / "sparse.npz", **points, obs_flow_err_px=np.zeros(3))
    sequence = open_folders("points", tmp_path).sequences[0]
    truth = sequence.truth(0)
    assert truth is not None
    assert (truth[3, 2], truth[0, 5], np.count_nonzero(truth)) == (4.0, 7.0, 2)
    assert sequence.notes == ("sparse truth: points of a reconstruction",)
    assert sequence.depth_unit == "arbitrary"


@pytest.mark.parametrize(
    ("text", "unit"),
    [("mm", "mm"), ("Millimetres", "mm"), ("metre", "m"), ("cm", "cm"), ("scene", "arbitrary"), (None, "arbitrary")],
)
def test_units_are_known_by_their_names(text: str | None, unit: str) -> None:
    assert known_unit(text) == unit

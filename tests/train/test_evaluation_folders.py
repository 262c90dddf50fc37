"""Data set folders: what is read, and which file is named when something is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.folders import DatasetFolder

H, W = 4, 6
CALIBRATION: dict[str, Any] = {
    "width": W, "height": H, "fx": 5.0, "fy": 5.0, "cx": 3.0, "cy": 2.0,
    "depth_scale": 0.5, "depth_unit": "mm", "pose_unit": "mm", "depth_valid": None, "note": "ignored",
}  # fmt: skip


def write_folder(path: Path, names: list[str] | None = None, **calibration: Any) -> Path:
    """Frames, dense depth (value = 10 * frame number + column + 1) and poses that move along z."""
    names = names or ["0000.png", "0001.png", "0002.png"]
    (path / "frames").mkdir(parents=True)
    (path / "depth").mkdir()
    lines = ["# a comment"]
    for number, name in enumerate(names):
        cv2.imwrite(str(path / "frames" / name), np.full((H, W, 3), (1, 2, 100 + number), np.uint8))
        values = np.tile(10 * number + np.arange(1, W + 1), (H, 1)).astype(np.uint16)
        cv2.imwrite(str(path / "depth" / f"{Path(name).stem}.png"), values)
        pose = np.eye(4)
        pose[2, 3] = number
        lines.append(" ".join([name, *map(str, pose.ravel())]))
    (path / "poses.txt").write_text("\n".join(lines) + "\n")
    (path / "intrinsics.json").write_text(json.dumps({**CALIBRATION, **calibration}))
    return path


def write_sparse(path: Path, **changes: Any) -> Path:
    write_folder(path, depth_scale=None, depth_unit="arbitrary")
    for file in (path / "depth").iterdir():
        file.unlink()
    (path / "depth").rmdir()
    arrays = {
        "points_xyz": np.zeros((1, 3), np.float32),
        "obs_frame": np.array([2, 0, 0, 0, 1]),
        "obs_uv": np.array([[0.9, 3.9], [5.99, 0.0], [1.0, 1.0], [6.0, 1.0], [2.0, 2.0]], np.float32),
        "obs_depth": np.array([3.0, 1.0, 2.0, 4.0, 5.0], np.float32),
        "obs_flow_err_px": np.array([0.99, 0.1, 1.0, 0.1, np.nan], np.float32),
    }
    np.savez(path / "sparse.npz", **{**arrays, **changes})
    return path


def test_depth_is_the_stored_value_times_the_scale(tmp_path: Path) -> None:
    folder = DatasetFolder.open(write_folder(tmp_path / "set"))
    known = folder.truth.at(1)
    assert (folder.name, folder.truth.kind, len(folder.frames)) == ("set", "dense", 3)
    np.testing.assert_allclose(known.depth, 0.5 * (10 + known.columns + 1))
    assert len(known.depth) == H * W


def test_images_are_rgb(tmp_path: Path) -> None:
    np.testing.assert_array_equal(DatasetFolder.open(write_folder(tmp_path / "set")).image(2)[0, 0], [102, 2, 1])


@pytest.mark.parametrize(
    "stored",
    [
        np.full((H, W, 4), (1 * 257, 2 * 257, 102 * 257, 65535), np.uint16),
        np.full((H, W, 3), (1, 2, 102), np.uint8),
        np.full((H, W, 4), (1, 2, 102, 255), np.uint8),
    ],
    ids=["16 bits with alpha", "8 bits", "8 bits with alpha"],
)
def test_frames_of_any_depth_and_transparency_become_8_bit_rgb(tmp_path: Path, stored: np.ndarray) -> None:
    path = write_folder(tmp_path / "set")
    cv2.imwrite(str(path / "frames" / "0000.png"), stored)
    np.testing.assert_array_equal(DatasetFolder.open(path).image(0)[0, 0], [102, 2, 1])


def test_zero_depth_the_mask_and_the_bounds_of_depth_valid_are_left_out(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "set", depth_valid=[1.0, 3.0])
    values = np.tile(np.array([0, 2, 3, 4, 6, 7], np.uint16), (H, 1))
    cv2.imwrite(str(path / "depth" / "0000.png"), values)
    mask = np.full((H, W), 255, np.uint8)
    mask[1:] = 0
    cv2.imwrite(str(path / "mask.png"), mask)
    known = DatasetFolder.open(path).truth.at(0)
    assert known.rows.tolist() == [0, 0]
    assert known.depth.tolist() == [1.5, 2.0]


def test_frames_follow_the_numbers_in_their_names(tmp_path: Path) -> None:
    folder = DatasetFolder.open(write_folder(tmp_path / "set", ["9.png", "10.png", "100.png"]))
    assert [frame.name for frame in folder.frames] == ["9.png", "10.png", "100.png"]
    assert folder.truth.at(1).depth[0] == 0.5 * 11


def test_frames_without_depth_or_pose_are_allowed(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "set")
    (path / "depth" / "0001.png").unlink()
    (path / "poses.txt").write_text("\n".join((path / "poses.txt").read_text().splitlines()[:3]))
    folder = DatasetFolder.open(path)
    assert len(folder.truth.at(1).depth) == 0
    assert folder.has_pose.tolist() == [True, True, False]


def test_without_poses_none_are_made_up(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "set")
    (path / "poses.txt").unlink()
    assert not DatasetFolder.open(path).has_pose.any()


def test_sparse_depth_is_at_the_pixel_that_holds_the_point_and_outliers_are_dropped(tmp_path: Path) -> None:
    folder = DatasetFolder.open(write_sparse(tmp_path / "set"))
    first, second, third = (folder.truth.at(t) for t in range(3))
    assert (first.rows.tolist(), first.columns.tolist(), first.depth.tolist()) == ([0], [5], [1.0])
    assert len(second.depth) == 0
    assert (third.rows.tolist(), third.columns.tolist(), third.depth.tolist()) == ([3], [0], [3.0])
    assert folder.truth.kind == "sparse"


def remove(name: str) -> Callable[[Path], None]:
    return lambda path: (path / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        (path / name).write_text(text)

    return change


def image(name: str, values: np.ndarray) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        cv2.imwrite(str(path / name), values)

    return change


def no_depth(path: Path) -> None:
    for file in (path / "depth").iterdir():
        file.unlink()


def calibration(**changes: Any) -> Callable[[Path], None]:
    return write("intrinsics.json", json.dumps({**CALIBRATION, **changes}))


WRONG = {
    "depth of a missing frame": (remove("frames/0001.png"), r"0001"),
    "pose of a missing frame": (write("poses.txt", "0007.png " + "0 " * 16), r"poses\.txt, line 1: pose of 0007\.png"),
    "short pose": (write("poses.txt", "0000.png 1 2 3"), r"poses\.txt, line 1: .*got 3"),
    "pose in words": (write("poses.txt", "0000.png " + "x " * 16), r"poses\.txt, line 1"),
    "pose that is no rotation": (write("poses.txt", "0000.png " + "2 " * 16), r"poses\.txt, line 1: .*no rotation"),
    "no intrinsics": (remove("intrinsics.json"), r"intrinsics\.json: missing"),
    "intrinsics in words": (write("intrinsics.json", "fx 3"), r"intrinsics\.json"),
    "no focal length": (calibration(fx=0), r"intrinsics\.json: fx"),
    "reversed range": (calibration(depth_valid=[9, 1]), r"intrinsics\.json: depth_valid"),
    "dense depth without scale": (calibration(depth_scale=None), r"depth_scale and depth_unit"),
    "dense depth without unit": (calibration(depth_unit=None), r"depth_scale and depth_unit"),
    "empty depth folder": (no_depth, r"depth: no depth maps"),
    "mask of another size": (image("mask.png", np.zeros((2, 3), np.uint8)), r"mask\.png: 3x2 pixels.* 6x4"),
    "mask that is no image": (write("mask.png", "text"), r"mask\.png: not a readable image"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_a_folder_that_cannot_be_used_says_which_file_is_wrong(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    path = write_folder(tmp_path / "set")
    change(path)
    with pytest.raises(DatasetError, match=message):
        DatasetFolder.open(path)


WRONG_PIXELS = {
    "depth of another size": (image("depth/0000.png", np.ones((2, 3), np.uint16)), r"depth/0000\.png: 3x2 .* 6x4"),
    "8-bit depth among 16-bit": (image("depth/0000.png", np.ones((H, W), np.uint8)), r"depth/0000\.png: .*16-bit"),
    "colour depth": (image("depth/0000.png", np.ones((H, W, 3), np.uint16)), r"depth/0000\.png: .*16-bit grey"),
    "damaged depth": (write("depth/0000.png", "\x89PNG"), r"depth/0000\.png: not a readable image"),
    "empty depth file": (write("depth/0000.png", ""), r"depth/0000\.png: not a readable image \(0 bytes\)"),
    "frame of another size": (image("frames/0000.png", np.ones((2, 3, 3), np.uint8)), r"frames/0000\.png: 3x2 .* 6x4"),
    "damaged frame": (write("frames/0000.png", "\x89PNG"), r"frames/0000\.png: not a readable image"),
}


@pytest.mark.parametrize(("change", "message"), WRONG_PIXELS.values(), ids=WRONG_PIXELS)
def test_pixels_that_cannot_be_used_say_in_which_file(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    path = write_folder(tmp_path / "set")
    change(path)
    folder = DatasetFolder.open(path)
    read = folder.truth.at if message.startswith("depth") else folder.image
    with pytest.raises(DatasetError, match=message):
        read(0)


WRONG_SPARSE = {
    "frame that is not there": ({"obs_frame": np.array([2, 0, 0, 0, 3])}, r"frame 3, but frames/ holds 3"),
    "lengths": ({"obs_depth": np.ones(2)}, r"sparse\.npz: .*do not match"),
    "only outliers": ({"obs_flow_err_px": np.full(5, 3.0)}, r"sparse\.npz: none of its 5 observations"),
    "pickled": ({"obs_depth": np.array([{}] * 5, object)}, r"sparse\.npz: not an npz"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG_SPARSE.values(), ids=WRONG_SPARSE)
def test_sparse_points_that_cannot_be_used_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write_sparse(tmp_path / "set", **changes)
    with pytest.raises(DatasetError, match=message):
        DatasetFolder.open(path)


def test_a_damaged_sparse_file_is_refused(tmp_path: Path) -> None:
    path = write_sparse(tmp_path / "set")
    (path / "sparse.npz").write_bytes((path / "sparse.npz").read_bytes()[:100])
    with pytest.raises(DatasetError, match=r"sparse\.npz"):
        DatasetFolder.open(path)


@pytest.mark.parametrize(("name", "what"), [("frames", "no .jpg or .png frames"), ("depth", "no true depth")])
def test_a_folder_without_frames_or_depth_is_refused(tmp_path: Path, name: str, what: str) -> None:
    path = write_folder(tmp_path / "set")
    (path / name).rename(path / "elsewhere")
    with pytest.raises(DatasetError, match=what):
        DatasetFolder.open(path)

"""Measured sequences and curves that a training run is watched by."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from bathyscope.errors import DatasetError
from bathyscope_train.curves import draw_curves, read_curves
from bathyscope_train.data.measured_clips import read_measured_clips
from bathyscope_train.validation import Example, write_grid

SIZE, FOCAL, CENTRE = (90, 160), 100.0, (76.0, 44.0)


def sequence(root: Path, frames: int = 20, posed: int | None = None) -> Path:
    """A ramp of depth, 1 mm a column, that is drawn as grey; poses move 1 mm a frame."""
    (root / "frames").mkdir(parents=True)
    (root / "depth").mkdir()
    columns = np.broadcast_to(np.arange(1, SIZE[1] + 1), SIZE)
    poses = []
    for k in range(frames):
        cv2.imwrite(str(root / "frames" / f"{k:04d}.png"), np.repeat(columns[..., None], 3, -1).astype(np.uint8))
        cv2.imwrite(str(root / "depth" / f"{k:04d}.png"), (columns * 10).astype(np.uint16))
        pose = np.eye(4)
        pose[0, 3] = k / 10
        poses.append(f"{k:04d}.png " + " ".join(f"{value:.6f}" for value in pose.ravel()))
    (root / "poses.txt").write_text("\n".join(poses[:posed]))
    calibration = {
        "width": SIZE[1],
        "height": SIZE[0],
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": CENTRE[0],
        "cy": CENTRE[1],
        "depth_scale": 0.1,
        "depth_unit": "mm",
        "pose_unit": "cm",
    }
    (root / "intrinsics.json").write_text(json.dumps(calibration))
    return root


def test_clips_are_cut_about_the_principal_point_with_their_truth(tmp_path: Path) -> None:
    clips = read_measured_clips(sequence(tmp_path / "ramp"), size=(44, 55), limit=3)
    assert [clip.name for clip in clips] == ["ramp-0000", "ramp-0002", "ramp-0004"]
    clip = clips[1]
    # 44 rows fit above and below the principal point: the box is 110 x 88, half of it 55 x 44.
    assert clip.focal == pytest.approx(FOCAL / 2)
    assert clip.frames.shape == (16, 3, 44, 55)
    left = CENTRE[0] - 55
    expected = left + 2 * np.arange(55) + 1.5  # the mean of two columns; depth is that of one of them
    np.testing.assert_allclose(clip.frames[0, 0, 20].numpy(), expected, atol=0.6)
    np.testing.assert_allclose(clip.depth[0, 20].numpy(), expected, atol=0.51)
    assert clip.world_from_camera[0, 0, 3] == pytest.approx(2)


def test_a_sequence_without_poses_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"bare.*poses"):
        read_measured_clips(sequence(tmp_path / "bare", posed=10))


def test_curves_are_told_apart_by_where_they_were_measured(tmp_path: Path) -> None:
    lines = [
        {"step": 10, "elapsed_s": 1.0, "progress": 0.1, "depth": 0.5},
        {"step": 20, "elapsed_s": 2.0, "progress": 0.2, "depth": 0.4},
        {"step": 20, "elapsed_s": 2.5, "validation": "held_out", "abs_rel": 0.3},
    ]
    metrics = tmp_path / "metrics.jsonl"
    metrics.write_text("\n".join(json.dumps(line) for line in lines))
    curves = read_curves(metrics)
    assert curves == {"depth": {"training": [(10, 0.5), (20, 0.4)]}, "abs_rel": {"held_out": [(20, 0.3)]}}
    draw_curves(metrics, tmp_path / "curves.png")
    picture = cv2.imread(str(tmp_path / "curves.png"))
    assert picture.shape[1] > 1000
    assert picture.std() > 5


def test_a_frame_without_truth_is_shown_in_the_range_of_its_own_depth(tmp_path: Path) -> None:
    ramp = torch.linspace(1, 3, 40).expand(30, 40)
    examples = [Example("ramp", torch.full((3, 30, 40), 0.5), ramp, true) for true in (2 * ramp, 0 * ramp)]
    write_grid(tmp_path / "grid.png", examples)
    picture = cv2.imread(str(tmp_path / "grid.png"))
    assert picture is not None
    known, unknown = picture[:, :120], picture[:, 120:]
    assert (known[:, 40:80] == unknown[:, 40:80]).all()
    assert (unknown[:, 80:] == unknown[0, 80]).all()  # no truth: one colour

"""Trajectory files against each other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bathyscope.errors import ResultError
from bathyscope.tum import tum_lines
from bathyscope_train.evaluation.cli import app
from bathyscope_train.evaluation.trajectory_files import compare_files, matched


def helix(frames: int, scale: float = 1.0) -> np.ndarray:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    t = np.arange(frames)
    poses[:, :3, 3] = scale * np.stack([np.cos(t / 3), np.sin(t / 3), 0.2 * t], -1)
    return poses


def write(path: Path, stamps: np.ndarray, poses: np.ndarray) -> Path:
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(tum_lines(stamps, poses)))
    return path


def test_a_trajectory_in_another_world_and_scale_has_no_error(tmp_path: Path) -> None:
    stamps = np.arange(12) / 25
    turned = helix(12, 0.3)
    turned[:, :3, 3] += (5, 6, 7)
    true, predicted = write(tmp_path / "a.txt", stamps, helix(12)), write(tmp_path / "b.txt", stamps + 0.004, turned)
    result = CliRunner().invoke(app, ["trajectory", str(true), str(predicted), "--gap", "2"])
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    assert scores["ate_rmse"] == pytest.approx(0, abs=1e-9)
    assert scores["rpe_translation"] == pytest.approx(0, abs=1e-9)
    assert (scores["pairs"], scores["aligned_frames"]) == (10, 12)
    assert scores["snippet_ate_mean"] == pytest.approx(0, abs=1e-6)


def test_frames_without_a_prediction_are_counted(tmp_path: Path) -> None:
    stamps = np.arange(12) / 25
    true = write(tmp_path / "a.txt", stamps, helix(12))
    some = write(tmp_path / "b.txt", stamps[::2], helix(12)[::2])
    scores, unmatched = compare_files(true, some, gap=1)
    assert (scores.aligned_frames, unmatched) == (6, 6)
    assert scores.ate_rmse == pytest.approx(0, abs=1e-9)


def test_time_stamps_are_matched_to_the_nearest_and_never_twice() -> None:
    mine, other = matched(np.array([0.0, 0.04, 0.05, 0.3]), np.array([0.01, 0.045, 0.2]), 0.02)
    assert mine.tolist() == [0, 1]
    assert other.tolist() == [0, 1]
    assert matched(np.array([0.0, 1.0]), np.array([1.0]), 0.02)[0].tolist() == [1]


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    true = write(tmp_path / "a.txt", np.arange(5.0), helix(5))
    late = write(tmp_path / "b.txt", np.arange(5.0) + 100, helix(5))
    with pytest.raises(ResultError, match="0 time stamps lie within"):
        compare_files(true, late, gap=1)
    back = write(tmp_path / "c.txt", np.arange(5.0)[::-1], helix(5))
    with pytest.raises(ResultError, match="must increase"):
        compare_files(true, back, gap=1)
    (tmp_path / "d.txt").write_text("# nothing\n")
    with pytest.raises(ResultError, match="no cameras"):
        compare_files(true, tmp_path / "d.txt", gap=1)

"""A whole evaluation with an engine whose answers are known."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from bathyscope.engines import DepthOptions
from bathyscope.errors import DatasetError
from bathyscope.model_spec import Output
from bathyscope.result import BundleId, FrameDepth, ResultMeta
from bathyscope_train.evaluation.cli import app
from bathyscope_train.evaluation.evaluate import evaluate
from bathyscope_train.evaluation.reports import EvaluationReport

H, W, T = 8, 10, 9
FOCAL = 12.0
Maps = Callable[[int], np.ndarray]


def true_depth(t: int) -> np.ndarray:
    """Whole numbers, as the PNG holds them."""
    return (100 + 20 * t + 10 * np.arange(W) + np.zeros((H, 1))).astype(np.uint16)


def true_pose(t: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = (0.5 * t, 0, 2 * t)
    return pose


def dataset(path: Path, *, unit: str = "mm", poses: bool = True) -> Path:
    (path / "frames").mkdir(parents=True)
    (path / "depth").mkdir()
    lines = []
    for t in range(T):
        # Brightness falls with the square of depth, so the brightness guess is right but for rounding.
        light = np.rint(255 * (100 / true_depth(t)) ** 2).astype(np.uint8)
        cv2.imwrite(str(path / "frames" / f"{t}.png"), np.repeat(light[..., None], 3, -1))
        cv2.imwrite(str(path / "depth" / f"{t}.png"), true_depth(t))
        lines.append(" ".join([f"{t}.png", *(str(value) for value in true_pose(t).ravel())]))
    if poses:
        (path / "poses.txt").write_text("\n".join(lines))
    calibration = {"width": W, "height": H, "fx": FOCAL, "fy": FOCAL, "cx": W / 2, "cy": H / 2}
    calibration |= {"depth_scale": 1.0, "depth_unit": unit, "pose_unit": unit, "depth_valid": None}
    (path / "intrinsics.json").write_text(json.dumps(calibration))
    return path


@dataclass
class Run:
    """Frames of the fake engine."""

    engine: Oracle
    options: DepthOptions
    closed: bool = False

    def __iter__(self) -> Iterator[FrameDepth]:
        assert self.options.max_frames is not None
        for t in range(min(self.options.max_frames, self.engine.frames)):
            depth = self.engine.maps[self.options.depth](t).astype(np.float32)
            k = np.array([[1.5 * FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
            pose = None if self.engine.pose is None else self.engine.pose(t)
            valid = np.ones(depth.shape, np.bool_)
            segment = int(t >= self.engine.cut)
            yield FrameDepth(t, t / 25, depth, np.ones_like(depth), valid, pose, None if pose is None else k, segment)

    def meta(self) -> ResultMeta:
        return ResultMeta(warnings=("as told",), outputs=self.engine.outputs)

    def close(self) -> None:
        self.closed = True


@dataclass
class Oracle:
    """An engine that answers what it was told."""

    maps: dict[str, Maps] = field(
        default_factory=lambda: {"rendered": lambda t: true_depth(t) / 50, "head": lambda t: true_depth(t) / 7}
    )
    pose: Maps | None = true_pose
    outputs: tuple[Output, ...] = ("depth", "confidence", "cameras")
    frames: int = T
    cut: int = T
    runs: list[Run] = field(default_factory=list)
    bundle: Any = field(
        default_factory=lambda: SimpleNamespace(id=BundleId(name="oracle", version="1", digest="0" * 64))
    )

    def warm_up(self) -> None:
        pass

    def run(self, source: Path, options: DepthOptions = DepthOptions(), *, name: str | None = None) -> Run:
        assert source.name == "frames"
        self.runs.append(Run(self, options))
        return self.runs[-1]


def half_scale(t: int) -> np.ndarray:
    pose = true_pose(t)
    pose[:3, 3] /= 50
    return pose


def test_a_prediction_right_up_to_scale_is_perfect_and_beats_both_guesses(tmp_path: Path) -> None:
    report = evaluate(Oracle(pose=half_scale), [dataset(tmp_path / "a")]).datasets[0]
    rendered, head = report.network["rendered"], report.network["head"]
    assert rendered.depth.abs_rel == pytest.approx(0, abs=1e-6)
    assert (rendered.depth.delta1, rendered.depth.coverage) == (1.0, 1.0)
    assert (rendered.depth.scale, head.depth.scale) == (pytest.approx(50, rel=1e-5), pytest.approx(7, rel=1e-5))
    assert report.baselines["inverse_sqrt_brightness"].abs_rel == pytest.approx(0, abs=0.02)
    assert rendered.poses is not None
    assert rendered.poses.ate_rmse == pytest.approx(0, abs=1e-9)
    assert rendered.poses.direction_cosine_mean == pytest.approx(1)
    assert rendered.poses.true_translation_mean == pytest.approx(6 * np.hypot(0.5, 2))
    assert rendered.poses.pairs == T - 6
    assert rendered.poses.pose_scale_over_depth_scale == pytest.approx(1, rel=1e-5)
    assert rendered.focal is not None
    assert (rendered.focal.fx_ratio, rendered.focal.fy_ratio) == (1.5, 1.0)
    assert rendered.warnings == ("as told",)


def test_the_constant_guess_is_the_median_depth_of_the_clip(tmp_path: Path) -> None:
    report = evaluate(Oracle(), [dataset(tmp_path / "a")]).datasets[0]
    depths = np.stack([true_depth(t) for t in range(T)]).astype(float)
    expected = (np.abs(depths - np.median(depths)) / depths).mean(axis=(1, 2)).mean()
    assert report.baselines["constant"].abs_rel == pytest.approx(expected)
    assert report.baselines["constant"].scale == np.median(depths)


def test_one_scale_serves_the_whole_clip(tmp_path: Path) -> None:
    """Each frame is right by itself, but the scale drifts: this must cost."""
    oracle = Oracle({"rendered": lambda t: true_depth(t) * (1 + 0.1 * t)})
    scores = evaluate(oracle, [dataset(tmp_path / "a")], kinds=["rendered"]).datasets[0].network["rendered"].depth
    drifts = 1 + 0.1 * np.arange(T)
    assert scores.scale is not None
    assert scores.abs_rel == pytest.approx(np.abs(scores.scale * drifts - 1).mean(), rel=1e-5)


def test_all_rows_are_measured_on_the_pixels_that_every_output_covers(tmp_path: Path) -> None:
    def left_half(t: int) -> np.ndarray:
        depth = true_depth(t).astype(float)
        depth[:, : W // 2] = 0
        return depth

    report = evaluate(Oracle({"rendered": left_half, "head": true_depth}), [dataset(tmp_path / "a")]).datasets[0]
    assert (report.counts.pixels, report.counts.pixels_with_truth) == (T * H * W // 2, T * H * W)
    assert report.network["rendered"].depth.coverage == 0.5
    assert report.network["head"].depth.coverage == 1.0
    depths = np.stack([true_depth(t)[:, W // 2 :] for t in range(T)])
    assert report.baselines["constant"].scale == np.median(depths)


def test_frames_without_truth_are_counted_out(tmp_path: Path) -> None:
    path = dataset(tmp_path / "a")
    (path / "depth" / "3.png").unlink()
    counts = evaluate(Oracle(), [path], kinds=["head"]).datasets[0].counts
    assert (counts.frames, counts.frames_with_truth) == (T, T - 1)


def test_without_poses_there_are_no_pose_scores(tmp_path: Path) -> None:
    report = evaluate(Oracle(), [dataset(tmp_path / "a", poses=False)], kinds=["head"])
    assert report.datasets[0].network["head"].poses is None


def test_a_model_without_cameras_has_depth_scores_alone(tmp_path: Path) -> None:
    part = evaluate(Oracle(pose=None), [dataset(tmp_path / "a")], kinds=["head"]).datasets[0].network["head"]
    assert (part.poses, part.focal) == (None, None)
    assert part.depth.abs_rel == pytest.approx(0, abs=1e-6)


def test_disparity_is_inverted_before_it_is_scaled(tmp_path: Path) -> None:
    oracle = Oracle({"head": lambda t: 50 / true_depth(t)}, pose=None, outputs=("disparity",))
    scores = evaluate(oracle, [dataset(tmp_path / "a")], kinds=["head"]).datasets[0].network["head"].depth
    assert scores.abs_rel == pytest.approx(0, abs=1e-6)


def test_segments_are_aligned_one_by_one_and_no_pair_crosses_a_cut(tmp_path: Path) -> None:
    def jumping(t: int) -> np.ndarray:
        pose = true_pose(t)
        pose[:3, 3] = pose[:3, 3] * 3 + 100 if t >= 5 else pose[:3, 3]
        return pose

    oracle = Oracle(pose=jumping, cut=5)
    part = evaluate(oracle, [dataset(tmp_path / "a")], kinds=["head"], gap=2).datasets[0].network["head"]
    assert part.poses is not None
    assert (part.segments, part.poses.pairs, part.poses.aligned_frames) == (2, 3 + 2, 9)
    assert part.poses.ate_rmse == pytest.approx(0, abs=1e-9)


def test_a_gap_longer_than_the_clip_leaves_pose_errors_empty_not_zero(tmp_path: Path) -> None:
    part = evaluate(Oracle(), [dataset(tmp_path / "a")], kinds=["head"], gap=20).datasets[0].network["head"]
    assert part.poses is not None
    assert (part.poses.pairs, part.poses.rotation_error_deg_mean, part.poses.rpe_translation) == (0, None, None)
    assert json.loads(part.model_dump_json())["poses"]["direction_cosine_mean"] is None


def test_a_mean_over_data_sets_leaves_out_errors_in_different_units(tmp_path: Path) -> None:
    oracle = Oracle()
    same = evaluate(oracle, [dataset(tmp_path / "a"), dataset(tmp_path / "b")], kinds=["head"])
    mixed = evaluate(oracle, [tmp_path / "a", dataset(tmp_path / "c", unit="cm")], kinds=["head"])
    assert same.mean["constant"].rmse == pytest.approx(same.datasets[0].baselines["constant"].rmse)
    assert mixed.mean["constant"].rmse is None
    assert mixed.mean["constant"].abs_rel == pytest.approx(same.mean["constant"].abs_rel)
    assert list(mixed.mean) == ["head", "constant", "inverse_sqrt_brightness"]


def test_only_the_first_frames_are_used_when_asked(tmp_path: Path) -> None:
    oracle = Oracle()
    report = evaluate(oracle, [dataset(tmp_path / "a")], kinds=["head"], max_frames=4)
    assert report.datasets[0].counts.frames == 4
    assert oracle.runs[0].options.max_frames == 4


def test_an_engine_that_loses_frames_is_noticed_and_its_run_closed(tmp_path: Path) -> None:
    oracle = Oracle(frames=T - 2)
    with pytest.raises(DatasetError, match="9 frames went in, 7 came back: as told"):
        evaluate(oracle, [dataset(tmp_path / "a")])
    assert oracle.runs[0].closed


def test_a_network_that_predicts_nothing_is_an_error_not_a_score(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="at none of the pixels"):
        evaluate(Oracle({"head": lambda t: np.zeros((H, W))}), [dataset(tmp_path / "a")], kinds=["head"])


def test_a_bad_folder_is_found_before_the_first_one_is_measured(tmp_path: Path) -> None:
    oracle = Oracle()
    with pytest.raises(DatasetError, match="nowhere"):
        evaluate(oracle, [dataset(tmp_path / "a"), tmp_path / "nowhere"])
    assert oracle.runs == []


@pytest.fixture
def installed_oracle(monkeypatch: pytest.MonkeyPatch) -> Oracle:
    oracle = Oracle()
    monkeypatch.setattr("bathyscope.engines.engine_factory", lambda: lambda bundle: oracle)
    monkeypatch.setattr("bathyscope.bundle.Bundle.open", classmethod(lambda cls, path: path))
    return oracle


def test_the_command_prints_one_json_object(tmp_path: Path, installed_oracle: Oracle) -> None:
    paths = [str(dataset(tmp_path / name)) for name in "ab"]
    result = CliRunner().invoke(app, [*paths, "--bundle", str(tmp_path), "--depth", "head", "--gap", "2", "--json"])
    assert result.exit_code == 0, result.output
    report = EvaluationReport.model_validate_json(result.stdout)
    assert [part.dataset for part in report.datasets] == ["a", "b"]
    assert report.protocol.frame_gap == 2
    assert [run.options.depth for run in installed_oracle.runs] == ["head", "head"]


def test_the_command_prints_tables_for_people(tmp_path: Path, installed_oracle: Oracle) -> None:
    path = str(dataset(tmp_path / "colon"))
    result = CliRunner().invoke(app, [path, "--bundle", str(tmp_path)], env={"COLUMNS": "140"})
    assert result.exit_code == 0, result.output
    for text in ("colon: 9 of 9 frames, 720 pixels", "AbsRel", "depth head", "constant", "ATE", "as told"):
        assert text in result.stdout


@pytest.mark.parametrize("arguments", [[], ["/no/such/folder"], [".", "--depth", "both", "--gap", "0"]])
def test_wrong_usage_ends_with_code_2(arguments: list[str]) -> None:
    assert CliRunner().invoke(app, arguments).exit_code == 2


def test_evaluation_needs_no_torch() -> None:
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import bathyscope_train.evaluation.cli, bathyscope_train.evaluation.tables\n"
        "import bathyscope_train.evaluation.runs.outputs, bathyscope_train.evaluation.runs.comparison_text\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)

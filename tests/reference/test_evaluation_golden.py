"""Whole protocols against the golden numbers of the published evaluators (``evaluation/*.npz`` and ``.json``)."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_sequences import MadeSequence

from bathyscope.camera import invert_pose
from bathyscope_train.evaluation import published_text
from bathyscope_train.evaluation.estimates import ArrayEstimates
from bathyscope_train.evaluation.frame_rows import FrameRow
from bathyscope_train.evaluation.intervals import grand_mean, student_interval
from bathyscope_train.evaluation.measure import Measurement, measure
from bathyscope_train.evaluation.protocols import Quirk, named_protocol
from bathyscope_train.evaluation.snippets import relative_poses, snippet_errors
from bathyscope_train.evaluation.vda_errors import inverse_rmse, log10_error, silog_error

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
FOLDER = REFERENCE / "evaluation"
LENGTHS = ("t_gt", "s_gt", "t_pred", "s_pred")
SEVEN = ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta1", "delta2", "delta3")
CLOSE: dict[str, Any] = {"rel": 1e-5, "abs": 1e-7, "nan_ok": True}


def cases(pattern: str) -> Any:
    found = sorted(FOLDER.glob(pattern))
    reason = f"no evaluation/{pattern} under {REFERENCE}"
    return found or [pytest.param(FOLDER / pattern, marks=pytest.mark.skip(reason=reason))]


def table(rows: tuple[FrameRow, ...], names: tuple[str, ...] = SEVEN) -> np.ndarray:
    return np.array([[getattr(row, name) for name in names] for row in rows])


def network_depth(disparity: np.ndarray, nearest: float, farthest: float) -> np.ndarray:
    scaled = 1 / farthest + (1 / nearest - 1 / farthest) * disparity.astype(np.float32)
    return (1 / scaled).astype(np.float32)


@pytest.mark.parametrize("path", cases("perframe_median*.npz"), ids=lambda path: path.stem)
def test_the_per_frame_protocol_is_that_of_the_single_frame_family(path: Path) -> None:
    expected = json.loads(path.with_suffix(".json").read_text())
    with np.load(path) as arrays:
        truth, disparity = arrays["gt_depth"], arrays["pred_disp"]
    protocol = replace(named_protocol("endodac", ["endodac"]), caps_mm=(1e-3, 150.0))
    found = measure(MadeSequence(truth), ArrayEstimates(disparity, "disparity"), protocol)
    numbers = table(found.rows)
    assert numbers == pytest.approx(np.array(expected["per_frame"], float), **CLOSE)
    counted = numbers[~np.isnan(numbers).all(axis=1)]
    assert len(counted) == expected["num_frames_counted"]
    means = [grand_mean([column], "frames") for column in numbers.T]
    assert means == pytest.approx(expected["mean"], rel=1e-5)
    intervals = [student_interval(column) for column in counted.T]
    assert np.array(intervals) == pytest.approx(np.array(expected["ci95"]), rel=1e-5)
    ratios = [row.scale for row in found.rows if not np.isnan(row.scale)]
    lines = [published_text.scaling_line(ratios), published_text.mean_line([*counted.T])]
    assert [*lines, published_text.interval_line([*counted.T])] == expected["printed"]


@pytest.mark.parametrize("kind", ["scale", "scale_shift", "per_frame_scale"])
@pytest.mark.parametrize("path", cases("video_protocol*.npz"), ids=lambda path: path.stem)
def test_the_video_protocols_are_those_of_endodav_and_the_paper(path: Path, kind: str) -> None:
    golden = json.loads(path.with_suffix(".json").read_text())
    expected = golden[kind]
    found = measured_video(path, golden, kind)
    frames = [table(part.rows) for part in found]
    for numbers, values in zip(frames, expected["per_frame"], strict=True):
        assert numbers == pytest.approx(np.array(values, float), **CLOSE)
    means = np.array([[grand_mean([column], "frames") for column in part.T] for part in frames])
    assert means == pytest.approx(np.array(expected["per_sequence_mean"]), rel=1e-5)
    for averaging, name in (("frames", "mean_over_all_frames"), ("sequences", "mean_of_sequence_means")):
        columns = [grand_mean([part[:, k] for part in frames], averaging) for k in range(len(SEVEN))]
        assert columns == pytest.approx(expected[name], rel=1e-5)
    if kind != "per_frame_scale":
        check_alignments(found, expected["alignment"])
        check_temporal(found, expected)
        check_printed(found, expected)


def measured_video(path: Path, golden: dict[str, Any], kind: str) -> list[Measurement]:
    published = named_protocol("endodav", ["endodav"])
    protocol = replace(
        published,
        quirks=published.quirks - {Quirk.FIXED_CAMERA},  # the golden file states the camera itself
        alignment="scale_shift" if kind == "scale_shift" else "scale",
        per="frame" if kind == "per_frame_scale" else "sequence",
        caps_mm=(golden["min_depth"], float(golden["max_depth"])),
    )
    found = []
    with np.load(path) as arrays:
        for number in range(len(golden["sequence_names"])):
            truth, disparity, pose, camera = (
                arrays[f"seq{number}_{name}"] for name in ("gt", "pred_disp", "pose_w2c", "K")
            )
            sequence = MadeSequence(
                truth, pose_unit="mm", world_from_camera=invert_pose(pose), intrinsics=camera[:3, :3].astype(float)
            )
            depth = network_depth(disparity, golden["net_min_depth"], golden["net_max_depth"])
            found.append(measure(sequence, ArrayEstimates(depth), protocol))
    return found


def check_alignments(found: list[Measurement], expected: list[dict[str, float]]) -> None:
    for part, values in zip(found, expected, strict=True):
        assert part.alignment is not None
        if "ratio" in values:
            scale, shift = values["ratio"], 0.0
        else:
            scale = values["s_gt"] / values["s_pred"]
            shift = values["t_gt"] - scale * values["t_pred"]
            assert part.alignment.lengths == pytest.approx([values[name] for name in LENGTHS], rel=1e-5)
        assert (part.alignment.scale, part.alignment.shift) == pytest.approx((scale, shift), rel=1e-5)


def check_temporal(found: list[Measurement], expected: dict[str, Any]) -> None:
    pairs = [table(part.rows, ("tae", "tas"))[:-1] for part in found]
    for numbers, values in zip(pairs, expected["temporal_per_pair"], strict=True):
        assert numbers == pytest.approx(np.array(values, float), rel=1e-5, abs=5e-4, nan_ok=True)
    for numbers, values in zip(pairs, expected["per_sequence_temporal"], strict=True):
        assert numbers.mean(axis=0) == pytest.approx(np.array(values, float), rel=1e-5, abs=5e-4, nan_ok=True)
    everything = np.concatenate(pairs).mean(axis=0)
    assert everything == pytest.approx(
        np.array(expected["mean_tae_tas_over_all_pairs"], float), rel=1e-5, abs=5e-4, nan_ok=True
    )
    assert not np.isnan([grand_mean([part[:, 0] for part in pairs], "frames")]).any()


def check_printed(found: list[Measurement], expected: dict[str, Any]) -> None:
    frames = np.concatenate([table(part.rows) for part in found])
    frames = frames[~np.isnan(frames).all(axis=1)]
    pairs = np.concatenate([table(part.rows, ("tae", "tas"))[:-1] for part in found])
    columns = [*frames.T, *pairs.T]
    alignments = [part.alignment for part in found if part.alignment is not None]
    if "ratio" in expected["alignment"][0]:
        first = published_text.scaling_line([alignment.scale for alignment in alignments])
    else:
        first = published_text.shift_line([part.lengths for part in alignments if part.lengths is not None])
    lines = [first, published_text.mean_line(columns), published_text.interval_line(columns)]
    assert lines == expected["printed"]


@pytest.mark.parametrize("path", cases("vda_affine_tae*.npz"), ids=lambda path: path.stem)
def test_the_affine_protocol_is_that_of_video_depth_anything(path: Path) -> None:
    expected = json.loads(path.with_suffix(".json").read_text())
    with np.load(path) as arrays:
        truth, disparity = arrays["gt"], arrays["pred_disp"]
        sequence = MadeSequence(
            truth, world_from_camera=arrays["pose_c2w"], intrinsics=arrays["K"].astype(float), pose_unit="mm"
        )
    protocol = replace(named_protocol("vda", ["vda"]), caps_mm=(1e-3, expected["max_depth"]))
    found = measure(sequence, ArrayEstimates(disparity, "disparity"), protocol)
    means = [grand_mean([column], "frames") for column in table(found.rows).T]
    names = ("abs_relative_difference", "squared_relative_difference", "rmse_linear", "rmse_log")
    assert means == pytest.approx(
        [expected[name] for name in (*names, "delta1_acc", "delta2_acc", "delta3_acc")], rel=1e-5
    )
    assert grand_mean([table(found.rows, ("tae",))], "frames") == pytest.approx(expected["tae"], abs=5e-4)
    assert found.alignment is not None
    pairs = aligned_pixels(truth, disparity, found)
    assert log10_error(pairs) == pytest.approx(expected["log10"], rel=1e-5)
    assert inverse_rmse(pairs) == pytest.approx(expected["i_rmse"], rel=1e-5)
    assert silog_error(pairs) == pytest.approx(expected["silog_rmse"], rel=1e-5)


def aligned_pixels(truth: np.ndarray, disparity: np.ndarray, found: Measurement) -> list[tuple[np.ndarray, np.ndarray]]:
    """The pixels that were measured, worked out once more with OpenCV and the fitted numbers."""
    import cv2

    assert found.alignment is not None
    low, high = found.caps
    pairs = []
    for g, d in zip(truth, disparity, strict=True):
        keep = (g > low) & (g < high)
        full = cv2.resize(d, (g.shape[1], g.shape[0]), interpolation=cv2.INTER_LINEAR)[keep]
        aligned = np.maximum(found.alignment.scale * full + found.alignment.shift, 1e-3)
        pairs.append((g[keep], np.clip(1 / aligned, low, high)))
    return pairs


@pytest.mark.parametrize("path", cases("pose_snippets*.npz"), ids=lambda path: path.stem)
def test_snippet_errors_are_those_of_the_field(path: Path) -> None:
    expected = json.loads(path.with_suffix(".json").read_text())
    with np.load(path) as arrays:
        true, predicted, poses = (arrays[name] for name in ("gt_local", "pred_local", "camera_pose_w2c"))
    assert relative_poses(poses) == pytest.approx(true, abs=1e-5)
    found = snippet_errors(true, predicted, expected.get("track_length", 5))
    assert found.ate == pytest.approx(np.array(expected["ate"]), rel=1e-5)
    assert found.rotation_rad == pytest.approx(np.array(expected["re_rad"]), rel=1e-5, abs=1e-7)
    summary = [expected[name] for name in ("ate_mean", "ate_std", "re_mean", "re_std")]
    assert found.summary() == pytest.approx(summary, rel=1e-5)

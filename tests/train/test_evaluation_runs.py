"""Whole evaluations on made folders: tables, going on after a stop, failures, comparison of two."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bathyscope.errors import SettingsError
from bathyscope_train.evaluation.arguments import arranged, spread
from bathyscope_train.evaluation.cli import app
from bathyscope_train.evaluation.frame_rows import read_rows
from bathyscope_train.evaluation.runs import jobs
from bathyscope_train.evaluation.runs.cells import number
from bathyscope_train.evaluation.runs.names import DataName, parse_systems
from bathyscope_train.systems.baselines import Baseline

H, W, T = 12, 16, 4


def folder(path: Path, *, unit: str = "mm", seed: int = 0, empty: tuple[int, ...] = ()) -> Path:
    """A data set folder whose brightness says little about depth; frames in ``empty`` have no truth."""
    rng = np.random.default_rng(seed)
    for name in ("frames", "depth"):
        (path / name).mkdir(parents=True)
    for t in range(T):
        depth = rng.integers(30, 120, (H, W)).astype(np.uint16)
        cv2.imwrite(str(path / "frames" / f"{t}.png"), rng.integers(20, 255, (H, W, 3)).astype(np.uint8))
        if t not in empty:
            cv2.imwrite(str(path / "depth" / f"{t}.png"), depth)
    calibration = {"width": W, "height": H, "fx": 20, "fy": 20, "cx": W / 2, "cy": H / 2}
    calibration |= {"depth_scale": 1.0, "depth_unit": unit, "pose_unit": None, "depth_valid": None}
    (path / "intrinsics.json").write_text(json.dumps(calibration))
    return path


def evaluate(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=True)


def rows_of(out: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((out / "summary.json").read_text())["rows"]
    return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    root = tmp_path_factory.mktemp("data")
    for number_ in range(3):
        folder(root / f"clip{number_}", seed=number_, empty=(1,) if number_ == 0 else ())
    out = root / "results"
    data = ["--data", f"set={root}", "--systems", "constant", "brightness", "vda-s"]
    return root, out, evaluate("--protocol", "paper", *data, "--out", str(out))


def test_every_file_is_written(finished: tuple[Path, Path, Result]) -> None:
    _, out, result = finished
    assert result.exit_code == 0, result.output
    names = ["run.json", "per_frame.csv", "per_sequence.csv", "summary.md", "summary.tex", "summary.json"]
    plots = ["set_depth.png", "set_sequences.png", "set_clip1_frames.png", "set_grid.png"]
    for name in [*names, *(f"plots/{plot}" for plot in plots)]:
        assert (out / name).stat().st_size > 0, name


def test_means_are_those_of_the_csv(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    row = next(row for row in rows_of(out) if row["system"] == "brightness")
    values: dict[str, list[float]] = {}
    for leading, frame in read_rows(out / "per_frame.csv"):
        if leading["system"] == "brightness" and frame.pixels:
            values.setdefault(leading["sequence"], []).append(frame.abs_rel)
    assert [len(part) for part in values.values()] == [T - 1, T, T]
    assert row["values"]["abs_rel"] == pytest.approx(np.mean([np.mean(part) for part in values.values()]))
    low, high = row["intervals_95"]["abs_rel"]
    assert low < row["values"]["abs_rel"] < high
    assert (row["measured_frames"], row["frames"], row["left_out"]) == (3 * T - 1, 3 * T, "1 no truth")


def test_a_number_never_stands_without_its_making(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    markdown, latex = (out / "summary.md").read_text(), (out / "summary.tex").read_text()
    split = json.loads((out / "run.json").read_text())["data"]["set"]["split_hash"]
    said = ("one factor", "plain mean over sequences", "caps 0 to 65536 mm", split, "pixels", "checkpoint none")
    for text in said:
        assert text in markdown, text
        assert text in latex, text


def test_columns_have_the_order_of_the_paper_and_the_best_is_bold(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    lines = (out / "summary.md").read_text().splitlines()
    head = next(line for line in lines if line.startswith("| Method"))
    assert head == "| Method | Year | Abs Rel ↓ | Sq Rel ↓ | RMSE ↓ | RMSE log ↓ | δ1 ↑ | coverage | checkpoint |"
    rows = {row["system"]: row["values"] for row in rows_of(out) if row["missing"] is None}
    better = min(rows, key=lambda name: rows[name]["abs_rel"])
    line = next(line for line in lines if line.startswith(f"| {better}"))
    assert f"| **{number(rows[better]['abs_rel'])}** |" in line
    latex = (out / "summary.tex").read_text()
    assert r"Dataset & Method & Year & Abs Rel $\downarrow$ & Sq Rel $\downarrow$ & RMSE $\downarrow$" in latex
    assert rf"\textbf{{{number(rows[better]['abs_rel'])}}}" in latex


def test_weights_that_are_not_at_hand_are_a_row_without_numbers(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    row = next(row for row in rows_of(out) if row["system"] == "vda-s")
    assert row["missing"].startswith("weights not available")
    assert row["values"] == {}
    assert "| vda-s | 2025 | weights not available |" in (out / "summary.md").read_text()


def test_a_finished_evaluation_is_not_measured_again(
    finished: tuple[Path, Path, Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, out, _ = finished
    monkeypatch.setattr(jobs, "measure", None)
    before = (out / "summary.json").read_text()
    data = ["--data", f"set={root}", "--systems", "constant", "brightness", "--no-plots"]
    again = evaluate("--protocol", "paper", *data, "--out", str(out))
    assert again.exit_code == 0, again.output
    rows = [row for row in json.loads(before)["rows"] if row["system"] != "vda-s"]
    assert rows_of(out) == rows


def test_a_stopped_evaluation_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number_ in range(3):
        folder(tmp_path / "data" / f"clip{number_}", seed=number_)
    arguments = ["--data", f"set={tmp_path / 'data'}", "--systems", "brightness", "--no-plots"]
    measure, done = jobs.measure, []

    def stop_at_the_second(sequence: Any, *rest: Any, **options: Any) -> Any:
        done.append(sequence.name)
        if len(done) == 2:
            raise KeyboardInterrupt
        return measure(sequence, *rest, **options)

    monkeypatch.setattr(jobs, "measure", stop_at_the_second)
    stopped = evaluate(*arguments, "--out", str(tmp_path / "out"))
    assert stopped.exit_code != 0
    assert not (tmp_path / "out" / "summary.md").exists()
    finished = evaluate(*arguments, "--out", str(tmp_path / "out"))
    assert finished.exit_code == 0, finished.output
    assert done == ["clip0", "clip1", "clip1", "clip2"]
    records = [
        json.loads((tmp_path / "out" / "jobs" / "brightness" / "set" / f"clip{n}" / "record.json").read_text())
        for n in range(3)
    ]
    assert [record["predict_ms"] is None for record in records] == [False, True, False]
    straight = evaluate(*arguments, "--out", str(tmp_path / "straight"))
    assert straight.exit_code == 0
    assert rows_of(tmp_path / "out") == rows_of(tmp_path / "straight")


def test_an_evaluation_of_something_else_is_not_mixed_in(tmp_path: Path) -> None:
    path = folder(tmp_path / "clip")
    common = ["--data", f"set={path}", "--systems", "constant", "--no-plots", "--out", str(tmp_path / "out")]
    assert evaluate("--protocol", "paper", *common).exit_code == 0
    other = evaluate("--protocol", "endodav", *common)
    assert isinstance(other.exception, SettingsError)
    assert "protocol paper" in str(other.exception)
    cv2.imwrite(str(path / "frames" / "9.png"), np.zeros((H, W, 3), np.uint8))
    changed = evaluate("--protocol", "paper", *common)
    assert "data set set" in str(changed.exception)


def test_a_missing_frame_fails_its_sequence_by_name_and_the_others_go_on(tmp_path: Path) -> None:
    for name in "ab":
        folder(tmp_path / "data" / name)
    (tmp_path / "data" / "a" / "frames" / "2.png").write_bytes(b"no picture")
    result = evaluate("--data", f"set={tmp_path / 'data'}", "--systems", "constant", "--out", str(tmp_path / "out"))
    assert result.exit_code == 1
    assert "constant on set/a: failed:" in result.output
    assert "2.png" in result.output
    row = rows_of(tmp_path / "out")[0]
    assert (row["sequences"], row["measured_sequences"], row["complete"]) == (2, 1, False)
    assert "1 of 2 sequences have numbers" in (tmp_path / "out" / "summary.md").read_text()


def test_truth_of_another_size_than_the_frames_is_named(tmp_path: Path) -> None:
    path = folder(tmp_path / "clip")
    cv2.imwrite(str(path / "depth" / "1.png"), np.full((H + 1, W), 50, np.uint16))
    result = evaluate("--data", f"set={path}", "--systems", "constant", "--no-plots", "--out", str(tmp_path / "out"))
    rows = {row.frame: row for _, row in read_rows(tmp_path / "out" / "per_frame.csv")}
    assert "16x13 pixels" in rows["1"].note
    assert "1 truth unreadable" in (tmp_path / "out" / "summary.md").read_text()
    assert result.exit_code == 0


def test_folders_that_are_no_data_set_are_gaps_and_end_with_code_1(tmp_path: Path) -> None:
    folder(tmp_path / "data" / "good")
    (tmp_path / "data" / "bad" / "frames").mkdir(parents=True)
    result = evaluate(
        "--data", str(tmp_path / "data"), "--systems", "constant", "--no-plots", "--out", str(tmp_path / "o")
    )
    assert result.exit_code == 1
    assert "data/bad" in result.output
    assert "no .jpg or .png frames" in result.output


def test_mixed_units_have_no_mean_of_lengths(tmp_path: Path) -> None:
    folder(tmp_path / "data" / "a")
    folder(tmp_path / "data" / "b", unit="scene")
    out = tmp_path / "out"
    result = evaluate("--data", f"set={tmp_path / 'data'}", "--systems", "constant", "--no-plots", "--out", str(out))
    assert result.exit_code == 0, result.output
    values = rows_of(out)[0]["values"]
    assert (values["rmse"], values["sq_rel"]) == (None, None)
    assert values["abs_rel"] > 0
    assert "mixed units (arbitrary, mm)" in (out / "summary.md").read_text()


def test_with_the_quirks_of_an_evaluator_its_printed_lines_are_written(tmp_path: Path) -> None:
    path, out = folder(tmp_path / "clip", empty=(2,)), tmp_path / "out"
    arguments = ["--protocol", "endodac", "--compat", "endodac", "--change", "per=frame", "caps=1:100"]
    result = evaluate(*arguments, "--data", f"set={path}", "--systems", "brightness", "--no-plots", "--out", str(out))
    assert result.exit_code == 0, result.output
    block = (out / "published.txt").read_text().splitlines()
    rows = [row for _, row in read_rows(out / "per_frame.csv") if row.pixels]
    assert block[0] == "brightness on set"
    assert block[1].startswith(f" Scaling ratios | med: {np.median([row.scale for row in rows]):0.3f} |")
    assert block[2].startswith(f"mean:&{np.mean([row.abs_rel for row in rows]):12.3f}")
    assert len(rows) == T - 1
    assert "quirks" in (out / "summary.md").read_text().lower()


@pytest.mark.parametrize("told", [False, True])
def test_systems_are_told_the_camera_matrix_only_when_the_protocol_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: bool
) -> None:
    heard: list[Any] = []
    estimate = Baseline.estimate

    def listen(self: Baseline, frames: Any, intrinsics: Any = None) -> Any:
        heard.append(intrinsics)
        return estimate(self, frames, intrinsics)

    monkeypatch.setattr(Baseline, "estimate", listen)
    change = ["--change", "intrinsics=known"] if told else []
    path = folder(tmp_path / "clip")
    result = evaluate(
        *change, "--data", f"set={path}", "--systems", "constant", "--no-plots", "--out", str(tmp_path / "o")
    )
    assert result.exit_code == 0, result.output
    assert len(heard) == 1
    assert (heard[0] is not None) == told
    said = "Camera matrix: told" if told else "Camera matrix: not told"
    assert said in (tmp_path / "o" / "summary.md").read_text()


def test_depth_that_is_not_metric_is_not_measured_without_an_alignment(tmp_path: Path) -> None:
    path, out = folder(tmp_path / "clip"), tmp_path / "out"
    arguments = ["--change", "alignment=none", "--data", f"set={path}", "--systems", "constant", "--no-plots"]
    result = evaluate(*arguments, "--out", str(out))
    assert result.exit_code == 1
    assert "gives relative depth, which needs an alignment" in result.output


def test_two_systems_are_compared_frame_by_frame(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    found = evaluate("diff", str(out), str(out), "--systems", "constant", "brightness")
    assert found.exit_code == 0, found.output
    with (out / "per_frame.csv").open() as file:
        table = list(csv.DictReader(file))
    means = {
        system: np.mean(
            [
                np.mean(
                    [
                        float(r["abs_rel"])
                        for r in table
                        if (r["system"], r["sequence"]) == (system, name) and r["abs_rel"]
                    ]
                )
                for name in ("clip0", "clip1", "clip2")
            ]
        )
        for system in ("constant", "brightness")
    }
    assert f"Means {number(float(means['constant']))} and {number(float(means['brightness']))}" in found.output
    assert "The second is worse." in found.output
    assert f"{3 * T - 1} frames were measured by both; 0 only by the first, 0 only by the second" in found.output
    same = evaluate("diff", str(out), str(out), "--systems", "constant", "--metric", "delta1")
    assert "No difference can be told." in same.output


def test_a_comparison_counts_frames_of_one_side_and_refuses_other_protocols(tmp_path: Path) -> None:
    path, outs = folder(tmp_path / "clip"), [tmp_path / name for name in "abc"]
    common = ["--data", f"set={path}", "--systems", "constant", "--no-plots", "--out"]
    assert evaluate(*common, str(outs[0])).exit_code == 0
    assert evaluate("--protocol", "endodav", "--change", "alignment=scale", *common, str(outs[1])).exit_code == 0
    other = evaluate("diff", str(outs[0]), str(outs[1]))
    assert "different protocols" in str(other.exception)
    (path / "depth" / "1.png").unlink()
    assert evaluate(*common, str(outs[2])).exit_code == 0
    found = evaluate("diff", str(outs[0]), str(outs[2]))
    assert f"{T - 1} frames were measured by both; 1 only by the first, 0 only by the second" in found.output
    assert "One sequence says nothing about others." in found.output


def test_comparison_needs_to_know_which_system(finished: tuple[Path, Path, Result]) -> None:
    _, out, _ = finished
    found = evaluate("diff", str(out), str(out))
    assert isinstance(found.exception, SettingsError)
    assert "name one with --systems" in str(found.exception)


def test_options_take_all_words_up_to_the_next_option() -> None:
    assert spread(["--data", "a", "b", "--out", "o", "x"]) == ["--data", "a", "--data", "b", "--out", "o", "x"]
    assert arranged(["--data", "a"], ["tables"])[0] == "tables"
    assert arranged(["clip", "--json"], ["tables"]) == ["folders", "clip", "--json"]
    assert arranged(["diff", "a", "b"], ["diff"]) == ["diff", "a", "b"]


def test_names_of_data_sets_and_systems_are_taken_apart(tmp_path: Path) -> None:
    found = DataName.parse(f"scared:video-val:keyframes={tmp_path}")
    assert (found.kind, found.split, found.frames, found.label) == (
        "scared",
        "video-val",
        "keyframes",
        "scared:video-val:keyframes",
    )
    with pytest.raises(SettingsError, match="no split of scared"):
        DataName.parse(f"scared:valid={tmp_path}")
    assert [system.label for system in parse_systems(["constant", "ours=shipped@head", "shipped@head"])] == [
        "constant",
        "ours",
        "shipped@head",
    ]
    with pytest.raises(SettingsError, match="named twice"):
        parse_systems(["constant", "constant"])


@pytest.mark.parametrize(
    ("layout", "head", "cells"),
    [
        ("components", "| Method | L_rgb | L_3D | L_temp |", "| guess | ✓ | × | ✓ |"),
        ("backbones", "| Backbone | Consistency |", "| guess | × |"),
    ],
)
def test_the_tables_of_ablations_read_what_a_system_was_trained_with_from_its_name(
    tmp_path: Path, layout: str, head: str, cells: str
) -> None:
    path = folder(tmp_path / "clip")
    systems = ["--systems", "guess+rgb+temp=constant", "--layout", layout, "--no-plots"]
    result = evaluate("--data", f"set={path}", *systems, "--out", str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    text = (tmp_path / "out" / "summary.md").read_text()
    assert head in text
    assert cells in text

"""Evaluations over public data sets, on small trees in their exact formats whose numbers are known in closed form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import data_set_trees as trees
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bathyscope_train.evaluation.cli import app

FRAMES = 5
DEPTHS = np.array([trees.plane_depth(index) for index in range(FRAMES)])
MIDDLE = float(np.median(DEPTHS))


def evaluate(out: Path, *arguments: str) -> tuple[Result, list[dict[str, Any]], str]:
    """Run with the constant guess alone: a plane seen head on is constant in every frame."""
    result = CliRunner().invoke(app, [*arguments, "--systems", "constant", "--no-plots", "--out", str(out)])
    if not (out / "summary.json").is_file():
        raise AssertionError(result.output) from result.exception
    return result, json.loads((out / "summary.json").read_text())["rows"], (out / "summary.md").read_text()


def test_scared_is_read_aligned_and_measured_and_missing_sequences_are_named(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "scared", 8, 0, FRAMES)
    result, rows, text = evaluate(tmp_path / "out", "--protocol", "paper", "--data", f"scared={tmp_path / 'scared'}")
    assert result.exit_code == 1
    for name in ("dataset8/keyframe1", "dataset9/keyframe3"):
        assert f"scared/{name}: " in result.output
    everything = next(row for row in rows if row["group"] == "all")
    assert everything["frames"] == FRAMES
    assert everything["values"]["abs_rel"] == pytest.approx(np.mean(np.abs(MIDDLE - DEPTHS) / DEPTHS), rel=1e-5)
    assert everything["values"]["rmse"] == pytest.approx(np.mean(np.abs(MIDDLE - DEPTHS)), rel=1e-5)
    # The camera comes 2 mm closer with each frame, which a constant does not know.
    assert everything["values"]["tae"] == pytest.approx(100 * 2 / MIDDLE, rel=1e-4)
    assert "caps 0.001 to 150 mm" in text
    assert "only keyframes were measured" in text


def test_keyframes_stand_beside_all_frames_and_are_aligned_alone(tmp_path: Path) -> None:
    trees.scared_official(tmp_path / "scared", 8, 0, FRAMES)
    root = tmp_path / "scared"
    _, rows, text = evaluate(tmp_path / "out", "--data", f"scared={root}", f"scared:keyframes={root}")
    group = next(row for row in rows if (row["dataset"], row["group"]) == ("scared", "keyframes"))
    measured = next(row for row in rows if (row["dataset"], row["group"]) == ("scared:keyframes", "all"))
    for row in (group, measured):
        assert row["measured_frames"] == 1
        assert row["values"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    assert "## scared, keyframes only" in text


def test_hamlyn_is_cropped_by_the_protocol_that_crops(tmp_path: Path) -> None:
    trees.hamlyn(tmp_path / "hamlyn", "rectified15", size=(288, 720))
    data = ("--data", f"hamlyn={tmp_path / 'hamlyn'}")
    cropped = evaluate(tmp_path / "a", "--protocol", "endodac", *data)
    whole = evaluate(tmp_path / "b", "--protocol", "paper", *data)
    pixels = []
    for out in ("a", "b"):
        rows = (tmp_path / out / "per_frame.csv").read_text().splitlines()
        place = rows[0].split(",").index("pixels")
        pixels.append(int(rows[1].split(",")[place]))
    assert pixels == [287 * 410, 287 * 720]
    assert cropped[0].exit_code == whole[0].exit_code == 1
    assert "hamlyn/rectified01" in whole[0].output


def test_c3vd_and_simcol_are_measured_in_millimetres(tmp_path: Path) -> None:
    trees.c3vd(tmp_path / "c3vd" / "trans_t1_a", FRAMES)
    trees.simcol(tmp_path / "simcol")
    data = ("--data", f"c3vd={tmp_path / 'c3vd'}", f"simcol={tmp_path / 'simcol'}")
    _, rows, text = evaluate(tmp_path / "out", *data)
    c3vd, simcol = rows[0]["values"], rows[1]["values"]
    assert c3vd["abs_rel"] == pytest.approx(np.mean(np.abs(MIDDLE - DEPTHS) / DEPTHS), rel=1e-3)
    assert c3vd["tae"] == pytest.approx(100 * 2 / MIDDLE, rel=1e-2)
    assert simcol["rmse"] == pytest.approx(0, abs=1e-4)
    scales = {line.split(",")[8] for line in (tmp_path / "out" / "per_sequence.csv").read_text().splitlines()[1:]}
    assert any(abs(float(scale) - 40.0) < 0.1 for scale in scales)
    assert "100 mm" in text

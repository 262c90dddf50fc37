"""The experiment driver: paired changes, tables, runs that are done once, and scores in closed form."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from consistency_runs import run_values, write_init

from bathyscope.errors import TrainingError
from bathyscope_train.consistency import ablation
from bathyscope_train.consistency.ablation import main
from bathyscope_train.consistency.ablation_table import Outcome, paired_change, tables
from bathyscope_train.consistency.rendered_clips import is_rendered, rendered_videos
from bathyscope_train.consistency.scores import NAMES, ClipScores, Scores, mean_scores, score_clip
from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.shards import read_clip, write_clips

CLIPS = np.array([0.1, 0.2, 0.4])


def test_the_same_gain_on_every_clip_has_no_interval() -> None:
    change = paired_change(CLIPS, np.stack([0.8 * CLIPS] * 5))
    assert (change.mean, change.low, change.high) == pytest.approx((-0.2, -0.2, -0.2))
    assert str(change) == "-20.0% [-20.0%, -20.0%]"


def test_seeds_that_disagree_widen_the_interval_over_zero() -> None:
    change = paired_change(CLIPS, np.stack([0.8 * CLIPS, 1.2 * CLIPS]))
    assert change.mean == pytest.approx(0)
    assert (change.low, change.high) == pytest.approx((-0.2, 0.2))


def outcome(variant: str, seed: int | None, abs_rel: list[float], **more: Any) -> Outcome:
    scores = [Scores(*(value,) * len(NAMES)) for value in abs_rel]
    clips = [ClipScores(f"c{number}", each, each) for number, each in enumerate(scores)]
    return Outcome(variant, seed, {"target": clips, "source": clips}, **more)


def test_tables_tell_means_changes_courses_and_failures() -> None:
    text = tables(
        [
            outcome("baseline", None, [0.2, 0.4]),
            outcome("all", 0, [0.1, 0.2], course=(0.3, 0.33, 0.15)),
            outcome("all", 1, [0.2, 0.4]),
            Outcome("rgb", 0, {}, failed="depth collapses"),
        ],
        baseline="baseline",
    )
    assert text.count("**Target domain") == text.count("**Source domain") == 2
    row = next(line for line in text.splitlines() if line.startswith("| all |"))
    assert row.startswith("| all | 0.2250 |")
    assert "| -25.0% [" in row
    assert row.endswith("| 50% | 2 of 2 |")
    assert "| all, seed 0 | 0.3000 | +10.0% | -50.0% |" in text
    assert "- rgb, seed 0: depth collapses" in text


def test_scores_are_closed_forms() -> None:
    truth = np.random.default_rng(0).uniform(1, 2, (4, 20, 30)).astype(np.float32)
    truth[:] = truth[0]
    exact = score_clip("a", 3 * truth, truth)
    assert asdict(exact.full) == pytest.approx(
        {"abs_rel": 0, "sq_rel": 0, "rmse": 0, "rmse_log": 0, "delta1": 1, "flicker": 0, "abs_rel_clip": 0}, abs=1e-5
    )
    border = truth.copy()
    border[:, :2], border[:, -2:], border[..., :3], border[..., -3:] = 9, 9, 9, 9
    assert score_clip("a", border, truth).central.abs_rel == pytest.approx(0, abs=1e-6)
    assert score_clip("a", border, truth).full.abs_rel > 0.5
    breathing = truth * np.array([1, 2, 1, 2], np.float32)[:, None, None]
    found = score_clip("a", breathing, truth).full
    assert found.abs_rel == pytest.approx(0, abs=1e-6)  # each frame has its own scale
    assert found.abs_rel_clip > 0.3  # one scale cannot suit both
    assert found.flicker == pytest.approx(100 * 2 * np.log(2), rel=1e-5)


def test_a_mean_leaves_clips_without_a_value_out() -> None:
    known, unknown = Scores(*(1.0,) * len(NAMES)), Scores(*(float("nan"),) * len(NAMES))
    assert mean_scores([known, unknown]) == known


@pytest.fixture(name="clips", scope="module")
def _clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("clips")
    for name, seeds in (("train", range(2)), ("held_out", range(900, 902))):
        assert list(write_clips(root / name, DOMAINS["source"], seeds, frames=8, size=(28, 42), processes=1))
    return root


def test_rendered_clips_are_videos_and_a_damaged_one_is_left_out(clips: Path, tmp_path: Path) -> None:
    path = next(iter(sorted((clips / "train").glob("*.npz"))))
    (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "9999999.npz").write_bytes(path.read_bytes()[:1000])
    assert is_rendered(tmp_path)
    assert not is_rendered(tmp_path.parent)
    (video,), (note,) = rendered_videos(tmp_path)
    assert (video.frames.read(3) == read_clip(path).frames[3]).all()
    assert "9999999.npz" in note


@pytest.mark.slow
def test_an_experiment_is_done_once_and_a_failed_run_does_not_stop_it(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_values(clips / "train", write_init(tmp_path / "start.safetensors"), tmp_path, steps=3, validate_every=3)
    run |= {"cache": str(tmp_path / "survey"), "validation_clips": 1}
    run["window"]["motion"] = 1e-4
    run["window"]["survey"] = {"still": 1e-9}
    settings = {
        "task": "ablation",
        "run": {name: value for name, value in run.items() if name not in ("out", "task")},
        "variants": {"all": {}, "breaks": {"loss.world.weight": 0}},
        "seeds": 1,
        "target": str(clips / "held_out"),
        "source": str(clips / "train"),
        "clips": 2,
        "out": str(tmp_path / "out"),
    }
    path = tmp_path / "ablation.yaml"
    path.write_text(yaml.safe_dump(settings))
    real = ablation.optimise

    def sometimes(chosen: Any) -> Path:
        if chosen.loss.world.weight == 0:
            raise TrainingError("depth collapses")
        return real(chosen)

    monkeypatch.setattr(ablation, "optimise", sometimes)
    assert main([str(path)]) == 0
    text = capsys.readouterr().out
    assert "| all | " in text
    assert "- breaks, seed 0: depth collapses" in text
    assert "| all, seed 0 |" in text
    monkeypatch.setattr(ablation, "optimise", lambda _: pytest.fail("a run that is done was done again"))
    assert main([str(path)]) == 0
    assert capsys.readouterr().out == text


def test_a_file_that_is_no_experiment_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "ablation.yaml"
    path.write_text("task: ablation\nvariants: {all: {}}\ntarget: a\nrun: {lr: 1, data: a, init: b}")
    assert main([str(path)]) == 2
    assert "lr" in capsys.readouterr().err
    assert main([]) == 2

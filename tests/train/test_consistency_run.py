"""Runs of the consistency optimisation: they repeat, resume after SIGKILL, share work, notice trouble, and report."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from consistency_runs import run_settings, run_values, totals, write_init, write_videos

from bathyscope.errors import DatasetError, SettingsError, TrainingError
from bathyscope_train.consistency import clip_step
from bathyscope_train.consistency.checkpoint_folder import checkpoint_folders, read_last_checkpoint
from bathyscope_train.consistency.journal import spoken
from bathyscope_train.consistency.settings import SafetySettings
from bathyscope_train.consistency.start import open_training_windows
from bathyscope_train.consistency.trainer import optimise
from bathyscope_train.consistency.watch import Watch
from bathyscope_train.metrics_file import drop_after
from bathyscope_train.model.checkpoints import load_network, training_of

COMMAND = "import sys; from bathyscope.cli import main; sys.argv = ['bathyscope', *sys.argv[1:]]; main()"


@pytest.fixture(name="start", scope="module")
def _start(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A folder of videos, and a checkpoint."""
    root = tmp_path_factory.mktemp("start")
    return write_videos(root / "videos"), write_init(root / "start.safetensors")


def test_a_run_trains_the_heads_and_writes_what_it_did(start: tuple[Path, Path], tmp_path: Path) -> None:
    path = optimise(run_settings(*start, tmp_path / "a", tensorboard=True, ema_decay=0.5))
    before, after = load_network(start[1])[0].state_dict(), load_network(path)[0].state_dict()
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"depth_head", "gaussian_param_head", "camera_head"}
    assert training_of(path)["step"] == 4
    assert training_of(path)["settings"]["data"][0]["folder"] == "videos"
    assert len(totals(tmp_path / "a")) == 4
    picture = cv2.imread(str(tmp_path / "a" / "pictures" / "step-0000001.png"))
    assert picture is not None
    (events,) = (tmp_path / "a" / "tensorboard").iterdir()
    assert b"training/image" in events.read_bytes()
    assert b"PNG" in events.read_bytes()


def test_parts_of_a_batch_add_up_to_the_whole(start: tuple[Path, Path], tmp_path: Path) -> None:
    for name, parts in (("whole", 1), ("parts", 2)):
        optimise(run_settings(*start, tmp_path / name, batch=2, accumulate=parts, steps=3))
    assert totals(tmp_path / "parts") == pytest.approx(totals(tmp_path / "whole"), rel=1e-4)


def write_run(tmp_path: Path, values: dict[str, Any]) -> Path:
    path = tmp_path / "settings.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_losses_of_one_that_was_not(start: tuple[Path, Path], tmp_path: Path) -> None:
    changes = {"steps": 8, "checkpoint_every": 3, "loaders": 1}
    optimise(run_settings(*start, tmp_path / "straight", **changes))
    path = write_run(tmp_path, run_values(*start, tmp_path / "killed", **changes))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, "-c", COMMAND, "train", str(path)], env=environment)
    metrics = tmp_path / "killed" / "metrics.jsonl"
    end = time.monotonic() + 300
    while time.monotonic() < end and not (metrics.is_file() and len(metrics.read_text().splitlines()) >= 4):
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    kept = read_last_checkpoint(tmp_path / "killed")
    assert kept is not None
    assert 3 <= kept.step < 8
    optimise(run_settings(*start, tmp_path / "killed", **changes))
    assert totals(tmp_path / "killed") == pytest.approx(totals(tmp_path / "straight"), rel=1e-6)
    assert list(totals(tmp_path / "killed")) == list(range(1, 9))


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one_with_the_same_batch(start: tuple[Path, Path], tmp_path: Path) -> None:
    changes = {"steps": 4, "batch": 2}
    optimise(run_settings(*start, tmp_path / "one", **changes))
    path = write_run(tmp_path, run_values(*start, tmp_path / "two", **changes))
    script = tmp_path / "train.py"
    script.write_text(COMMAND)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*launcher, str(script), "train", str(path)], env=environment, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert totals(tmp_path / "two") == pytest.approx(totals(tmp_path / "one"), rel=1e-4)
    begun, one, two = (
        torch.cat([value.flatten() for value in load_network(weights)[0].parameters()])
        for weights in (start[1], tmp_path / "one" / "model.safetensors", tmp_path / "two" / "model.safetensors")
    )
    assert (two - one).norm() < 0.05 * (one - begun).norm()


def test_a_loss_that_is_not_finite_stops_the_run_at_the_last_good_checkpoint(
    start: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = clip_step.consistency_terms, []

    def breaks(*args: Any, **named: Any) -> dict[str, torch.Tensor]:
        calls.append(1)
        terms = real(*args, **named)
        return terms if len(calls) < 4 else {**terms, "world": terms["world"] * float("nan")}

    monkeypatch.setattr(clip_step, "consistency_terms", breaks)
    with pytest.raises(TrainingError, match=r"step 3: total, world not finite, on pan\d. Try a smaller peak_lr"):
        optimise(run_settings(*start, tmp_path / "a"))
    kept = read_last_checkpoint(tmp_path / "a")
    assert kept is not None
    assert kept.step == 2
    assert all(bool(value.isfinite().all()) for value in kept.model.values())
    assert not (tmp_path / "a" / "model.safetensors").exists()


def test_depth_that_flattens_for_some_steps_is_noticed() -> None:
    watch = Watch(SafetySettings(least_variation=0.5, steps=3))
    for step, variation in enumerate((1.0, 0.2, 0.4)):  # mean 0.53
        watch.see(step, {"variation": variation})
    with pytest.raises(TrainingError, match=r"depth collapses: .* varies 33% as much .* loss.temporal.weight"):
        watch.see(3, {"variation": 0.4})


def test_updates_without_finite_gradients_are_left_out_until_there_are_too_many() -> None:
    watch = Watch(SafetySettings(skipped=2))
    watch.skip(0)
    watch.took_step()
    watch.skip(2)
    with pytest.raises(TrainingError, match="2 updates in a row"):
        watch.skip(3)


def test_another_run_in_the_same_folder_is_refused(start: tuple[Path, Path], tmp_path: Path) -> None:
    optimise(run_settings(*start, tmp_path / "a", steps=3))
    with pytest.raises(SettingsError, match=r"holds a run with other settings \(peak_lr 0.0002, now 0.001"):
        optimise(run_settings(*start, tmp_path / "a", steps=3, peak_lr=1e-3))
    again = optimise(run_settings(*start, tmp_path / "a", steps=3, log_every=2))  # is done, and says so again
    assert training_of(again)["step"] == 3
    assert [path.name for path in checkpoint_folders(tmp_path / "a")] == ["step-0000002", "step-0000003"]


def test_what_cannot_be_used_is_named_and_the_rest_is_trained_on(tmp_path: Path) -> None:
    data = write_videos(tmp_path / "videos", count=1)
    (data / "single").mkdir()
    cv2.imwrite(str(data / "single" / "0.png"), np.full((56, 84, 3), 90, np.uint8))
    (data / "black").mkdir()
    for number in range(8):
        cv2.imwrite(str(data / "black" / f"{number}.png"), np.zeros((56, 84, 3), np.uint8))
    (data / "broken.mp4").write_bytes(b"not a video")
    cv2.imwrite(str(data / "pan0" / "003.png"), np.full((30, 40, 3), 90, np.uint8))
    windows = open_training_windows(run_settings(data, tmp_path, tmp_path / "out"))
    assert [sequence.name for sequence, _ in windows.clips] == ["pan0"]
    notes = "\n".join(windows.notes)
    for name in ("single: 1 frame", "black", "broken.mp4", "003.png (40x30)"):
        assert name in notes, notes


def test_a_folder_with_nothing_to_train_on_says_why(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"empty: nothing to train on"):
        open_training_windows(run_settings(tmp_path / "empty", tmp_path, tmp_path / "out"))


def test_shares_of_a_batch_have_to_be_whole(start: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="a batch of 3 cannot be shared evenly by 1 processes in 2 parts"):
        optimise(run_settings(*start, tmp_path / "a", batch=3, accumulate=2))


def test_weights_as_shares_make_every_term_as_large_as_its_share(start: tuple[Path, Path], tmp_path: Path) -> None:
    optimise(run_settings(*start, tmp_path / "a", balance_steps=2, steps=3, peak_lr=1e-9))
    kept = read_last_checkpoint(tmp_path / "a")
    assert kept is not None
    weights = kept.memory["balance"]
    assert weights["image"] == 1
    lines = [json.loads(line) for line in (tmp_path / "a" / "metrics.jsonl").read_text().splitlines()]
    sizes = {name: np.mean([line[name] for line in lines]) for name in ("image", "temporal")}
    assert weights["temporal"] * sizes["temporal"] == pytest.approx(sizes["image"], rel=0.7)


def test_metrics_of_steps_that_are_done_again_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2, "validation": "a"}\n{"step": 3}\n{"ste')
    drop_after(path, 2)
    assert path.read_text() == '{"step": 1}\n{"step": 2, "validation": "a"}\n'


@pytest.mark.parametrize(("seconds", "text"), [(40, "40 s"), (600, "10 min"), (3 * 3600 + 290, "3 h 05 min")])
def test_times_are_told_as_a_person_would(seconds: float, text: str) -> None:
    assert spoken(seconds) == text

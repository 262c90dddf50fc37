"""A pre-training run: what it learns from nothing in a minute, that it repeats, resumes and refuses."""

import json
import tempfile
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from typer.testing import CliRunner

from bathyscope.errors import CheckpointError, SettingsError
from bathyscope_train.cli import app
from bathyscope_train.config import PretrainSettings, SourceSettings, load_settings
from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.shards import write_clips
from bathyscope_train.data.truth_clips import read_truth_clips
from bathyscope_train.devices import use_bfloat16
from bathyscope_train.losses.supervised import supervised_objective
from bathyscope_train.metrics_file import METRICS_FILE
from bathyscope_train.model import Network
from bathyscope_train.model.checkpoints import load_network, save_checkpoint, training_of
from bathyscope_train.model.presets import (
    AggregatorSettings,
    DptSettings,
    IterativeCameraSettings,
    MatchingCameraSettings,
    NetworkPreset,
    VitSettings,
)
from bathyscope_train.pretrain import WEIGHTS_FILE, draw_pairs, pretrain
from bathyscope_train.pretrain_record import training_record
from bathyscope_train.schedule import ema_decay, learning_rate_factor, source_shares
from bathyscope_train.training_state import STATE_FILE
from bathyscope_train.validation import validate

SIZE = (56, 70)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve small clips for training and four others for validation."""
    root = tmp_path_factory.mktemp("clips")
    for name, seeds in (("train", range(12)), ("held_out", range(900, 904))):
        assert list(write_clips(root / name, DOMAINS["source"], seeds, frames=12, size=SIZE, processes=1))
    return root


def settings(clips: Path, out: Path, **changes: object) -> PretrainSettings:
    values: dict[str, object] = {
        "data": (SourceSettings(folder=clips / "train"),),
        "out": out,
        "steps": 2,
        "batch": 1,
        "frames": 5,
        "pairs": 4,
        "seed": 5,
    }
    return PretrainSettings.model_validate(values | changes)


@pytest.mark.slow
def test_a_minute_of_training_beats_the_best_constant_map_on_unseen_scenes(clips: Path, tmp_path: Path) -> None:
    chosen = settings(
        clips,
        tmp_path,
        steps=100,
        warmup_steps=10,
        ema_decay=0.9,
        peak_lr=2e-3,
        validation=(clips / "held_out",),
    )
    network, _ = load_network(pretrain(chosen))
    result, _ = validate(network, read_truth_clips(clips / "held_out"), frames=5)
    assert result.abs_rel < 0.85 * result.best_map
    assert result.abs_rel < 0.75 * result.constant
    lines = [json.loads(line) for line in (tmp_path / METRICS_FILE).read_text().splitlines()]
    assert {line["validation"] for line in lines if "validation" in line} == {"held_out"}
    assert (tmp_path / "validation.png").stat().st_size > 1000


def test_the_same_seed_gives_the_same_weights(clips: Path, tmp_path: Path) -> None:
    first, second = (load_file(pretrain(settings(clips, tmp_path / name))) for name in ("a", "b"))
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_two_workers_learn_from_all_windows_of_a_batch(clips: Path, tmp_path: Path) -> None:
    """Their averaged gradient moves both copies alike; the file says how the weights came about."""
    path = pretrain(settings(clips, tmp_path, workers=2, batch=2))
    assert training_of(path)["step"] == 2
    assert load_network(path)[1].complete


def test_an_interrupted_run_goes_on_where_it_stopped(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = load_file(pretrain(settings(clips, tmp_path / "whole", steps=3)))
    chosen = settings(clips, tmp_path / "parts", steps=3, checkpoint_minutes=1e-9)
    with monkeypatch.context() as patch:
        interrupted = Mock(wraps=supervised_objective, side_effect=[DEFAULT, DEFAULT, KeyboardInterrupt])
        patch.setattr("bathyscope_train.pretrain.supervised_objective", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pretrain(chosen)
    assert torch.load(tmp_path / "parts" / STATE_FILE, weights_only=True)["step"] == 2
    with (tmp_path / "parts" / METRICS_FILE).open("a") as file:
        file.write('{"step": 2, "depth": 0.5}\n{"step": 3, "depth": 0.5}\n{"step": 3, "de')
    parts = load_file(pretrain(chosen))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    told = [json.loads(line) for line in (tmp_path / "parts" / METRICS_FILE).read_text().splitlines()]
    assert told == [{"step": 2, "depth": 0.5}], "lines about steps that are done again go"


def test_the_weights_say_how_they_were_made_but_not_on_whose_machine(clips: Path, tmp_path: Path) -> None:
    chosen = settings(clips, tmp_path, initial=tmp_path / "first.safetensors", validation=(clips / "held_out",))
    record = training_record(chosen)
    assert record["data"][0]["folder"] == "train"
    assert (record["initial"], record["validation"]) == ("first.safetensors", ["held_out"])
    assert (record["steps"], record["loss"]["motion"]) == (2, 1.0)
    assert str(tmp_path.parent) not in json.dumps(record)


def test_a_run_can_start_from_the_weights_of_another(clips: Path, tmp_path: Path) -> None:
    first = pretrain(settings(clips, tmp_path / "first"))
    path = pretrain(settings(clips, tmp_path / "second", initial=first, steps=1, peak_lr=1e-9, seed=9))
    made = training_of(path)
    assert made["began_with"] == training_of(first)
    assert made["clips"] == {"train": "12 clips, seeds 0 to 11"}
    before, after = load_file(first), load_file(path)
    assert max(float((before[name] - after[name]).abs().max()) for name in before) < 1e-6


def test_a_run_can_change_how_far_small_motions_are_held_back(clips: Path, tmp_path: Path) -> None:
    first = pretrain(settings(clips, tmp_path / "first", steps=1))
    path = pretrain(settings(clips, tmp_path / "second", initial=first, steps=1, flow_noise=0.25, peak_lr=1e-9))
    before, after = load_network(first)[0].preset, load_network(path)[0].preset
    assert isinstance(before.camera, MatchingCameraSettings)
    assert after == before.model_copy(update={"camera": before.camera.model_copy(update={"flow_noise": 0.25})})


def test_what_is_wrong_in_a_worker_is_told_as_if_there_were_one(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By one line; the folder where the workers met is gone afterwards."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    chosen = settings(clips, tmp_path, preset="tiny-lite0", encoder=tmp_path / "none.pth", workers=2, batch=2)
    with pytest.raises(CheckpointError, match=r"^[^\n]*none.pth: cannot be read[^\n]*$"):
        pretrain(chosen)
    assert not list(temporary.glob("bathyscope-*"))


def test_a_damaged_state_is_refused_by_name(clips: Path, tmp_path: Path) -> None:
    (tmp_path / STATE_FILE).write_bytes(b"not a state")
    with pytest.raises(CheckpointError, match=STATE_FILE):
        pretrain(settings(clips, tmp_path))


def test_presets_without_a_matching_camera_head_are_refused(clips: Path, tmp_path: Path) -> None:
    small = NetworkPreset(
        name="small",
        stem=VitSettings(depth=1, heads=1, grid=2),
        aggregator=AggregatorSettings(width=16, depth=4, heads=1, taps=(0, 1, 2, 3)),
        camera=IterativeCameraSettings(depth=1, heads=1, iterations=1),
        depth=DptSettings(features=8, channels=(8, 8, 8, 8)),
        gaussians=None,
    )
    save_checkpoint(Network(small), tmp_path / "small.safetensors")
    with pytest.raises(SettingsError, match="matching camera head"):
        pretrain(settings(clips, tmp_path / "other", initial=tmp_path / "small.safetensors"))


def test_the_command_reads_yaml_and_overrides_and_prints_where_the_weights_are(clips: Path, tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("batch: 1\nframes: 5\npairs: 3\nsteps: 9\nloss: {motion: 0.5}\n")
    out = tmp_path / "run"
    overrides = [f"data={clips / 'train'}", f"out={out}", "steps=1", "loss.flow=0"]
    result = CliRunner().invoke(app, [str(file), *overrides])
    assert result.exit_code == 0, result.output
    assert str(out / WEIGHTS_FILE) in result.output
    used = json.loads((out / "settings.json").read_text())
    assert (used["steps"], used["loss"]["motion"], used["loss"]["flow"]) == (1, 0.5, 0)


@pytest.mark.parametrize(
    ("text", "overrides", "message"),
    [
        ("frames: 3\n", ["data=a", "out=b"], "windows need more than 4 frames"),
        ("batch: 3\nworkers: 2\n", ["data=a", "out=b"], "shared evenly"),
        ("speed: 3\n", ["data=a", "out=b"], "speed"),
        ("", ["data"], "name=value"),
        ("[1, 2]\n", [], "mapping"),
        ("a: [\n", [], "cannot read"),
    ],
    ids=["short windows", "odd batch", "unknown", "override", "list", "yaml"],
)
def test_settings_that_cannot_work_are_refused(tmp_path: Path, text: str, overrides: list[str], message: str) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError, match=message):
        load_settings(file, overrides)


@pytest.mark.parametrize("name", ["source.yaml", "pretrain.yaml", "finish.yaml", "pretrain_gpu.yaml"])
def test_the_shipped_settings_are_valid(name: str) -> None:
    path = Path(__file__).parents[2] / "configs" / name
    assert load_settings(path, ["minutes=5"]).minutes == 5


def test_the_learning_rate_warms_up_and_ends_at_its_floor() -> None:
    assert learning_rate_factor(0, 0, warmup_steps=9) == pytest.approx(0.1)
    assert learning_rate_factor(9, 0, warmup_steps=9) == pytest.approx(1)
    assert learning_rate_factor(50, 0.5, warmup_steps=9) == pytest.approx(0.505)
    assert learning_rate_factor(90, 1.2, warmup_steps=9) == pytest.approx(0.01)
    assert ema_decay(0, 0.99) == pytest.approx(0.1)
    assert ema_decay(10_000, 0.99) == 0.99


def test_a_data_folder_joins_at_its_start() -> None:
    sources = [SourceSettings(folder=Path("a"), share=1), SourceSettings(folder=Path("b"), share=3, start=0.5)]
    assert source_shares(sources, 0.49) == [1, 0]
    assert source_shares(sources, 0.5) == [0.25, 0.75]


def test_supervised_pairs_are_those_of_the_trajectory_without_repetition() -> None:
    pairs = draw_pairs(8, 10, np.random.default_rng(0))
    assert len({*zip(pairs.source.tolist(), pairs.target.tolist(), strict=True)}) >= 8  # a loop may be a neighbour too
    assert len(pairs.source) == 10
    assert pairs.inside.all()
    assert len(draw_pairs(5, 99, np.random.default_rng(0)).source) == 4 + 3 + 1 + 4


def test_bfloat16_is_used_on_request_and_never_by_default() -> None:
    assert use_bfloat16("bfloat16")
    assert not use_bfloat16("float32")

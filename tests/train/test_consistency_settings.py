"""Settings of the consistency optimisation: the paper's by default, refused where they contradict, told by task."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from consistency_runs import run_settings, uneven_network, write_init, write_videos
from torch import nn
from typer.testing import CliRunner

from bathyscope.errors import CheckpointError, SettingsError
from bathyscope_train.cli import app
from bathyscope_train.consistency.ablation_settings import load_ablation_settings
from bathyscope_train.consistency.memory import expected_memory
from bathyscope_train.consistency.parts import learning_rate, set_trainable, trained_groups
from bathyscope_train.consistency.settings import PartSettings, load_consistency_settings
from bathyscope_train.consistency.start import load_initial
from bathyscope_train.tasks import task_of

CONFIGS = Path(__file__).parents[2] / "configs"
GIVEN = ["data=videos", "init=start.safetensors"]


def test_the_shipped_settings_are_the_papers() -> None:
    settings = load_consistency_settings(CONFIGS / "consistency.yaml", GIVEN)
    assert (settings.steps, settings.warmup_steps, settings.peak_lr) == (20_000, 2_000, 2e-4)
    assert (settings.window.frames, settings.loss.world.stride, settings.loss.temporal.stride) == (16, 6, 6)
    assert settings.loss.weights == {"image": 1, "world": 1, "temporal": 1, "matches": 0, "anchor": 0}
    assert settings.parts["camera_head"].after_warmup
    fresh = load_consistency_settings(CONFIGS / "consistency-small.yaml", [*GIVEN, "steps=20001", "batch=8"])
    assert (fresh.steps, fresh.batch) == (20_001, 8)


def test_the_rate_rises_to_its_peak_and_falls_as_a_cosine(tmp_path: Path) -> None:
    settings = run_settings(tmp_path, tmp_path, tmp_path, steps=110, warmup_steps=10, final_lr=0.1)
    assert learning_rate(0, settings) == pytest.approx(2e-4 / 11)
    assert learning_rate(10, settings) == pytest.approx(2e-4)
    assert learning_rate(35, settings) == pytest.approx(2e-4 * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi / 4))))
    assert learning_rate(110, settings) == pytest.approx(2e-5)


def test_the_camera_head_trains_after_the_warm_up_and_the_rest_never(tmp_path: Path) -> None:
    settings, network = run_settings(tmp_path, tmp_path, tmp_path, steps=9, warmup_steps=4), uneven_network()
    groups = trained_groups(network, settings.parts)
    assert set_trainable(network, groups, 3, settings) == {"depth_head", "gaussian_param_head"}
    assert not any(value.requires_grad for value in network.camera_head.parameters())
    assert set_trainable(network, groups, 4, settings) == {"camera_head", "depth_head", "gaussian_param_head"}
    assert all(value.requires_grad for value in network.camera_head.parameters())
    assert not any(value.requires_grad for value in network.aggregator.parameters())


def test_the_longest_beginning_of_a_name_counts_and_vectors_do_not_decay() -> None:
    network = nn.ModuleDict({"head": nn.ModuleDict({"a": nn.Linear(2, 3), "b": nn.Linear(2, 2)})})
    groups = trained_groups(network, {"head": PartSettings(rate=0.5), "head.b": PartSettings(rate=0)})
    assert {group.names: group.decayed for group in groups} == {("head.a.weight",): True, ("head.a.bias",): False}
    with pytest.raises(SettingsError, match="begins with 'tail'; its parts are head"):
        trained_groups(network, {"tail": PartSettings()})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": {"frames": 2}}, "windows of 2 frames hold no pair"),
        ({"warmup_steps": 4}, "a warm-up of 4 steps does not fit into 4"),
        ({"parts": {"depth_head": {"rate": 0}}}, "nothing would be trained"),
        ({"lr": 1}, "lr"),
        ({"batch": 0}, "batch"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        run_settings(tmp_path, tmp_path, tmp_path, **changes)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("task: consistency", "consistency"),
        ("data: [{folder: a}]\nout: b", "pretrain"),
        ("init: a\npeak_lr: 1.0e-4", "consistency"),
        ("base: small.yaml\ntarget: a", "ablation"),
    ],
)
def test_a_file_is_told_by_its_task_or_its_settings(tmp_path: Path, text: str, kind: str) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    assert task_of(path) == kind


def test_a_file_of_no_kind_says_which_is_nearest(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text("init: a\nlearning_rate: 1")
    with pytest.raises(SettingsError, match=r"say task: .* Nearest is 'consistency', which has no learning_rate"):
        task_of(path)
    path.write_text("task: optimise")
    with pytest.raises(SettingsError, match="task is 'optimise'; known are pretrain, consistency, ablation"):
        task_of(path)


def test_an_experiment_hands_overrides_to_its_runs() -> None:
    settings = load_ablation_settings(
        CONFIGS / "ablation.yaml", ["init=a.safetensors", "loss.world.delta=0.2", "seeds=2"]
    )
    assert settings.seeds == (0, 1)
    run = settings.run_settings("rgb + temp", 1)
    assert (run.loss.world.weight, run.loss.world.delta, run.seed) == (0, 0.2, 1)
    assert run.out.name == "rgb-+-temp-seed1"
    assert settings.run_settings("all", 0).loss.world.weight == 1


def test_the_stability_experiment_is_five_runs_of_one_clip_a_step() -> None:
    settings = load_ablation_settings(CONFIGS / "stability.yaml", ["init=a.safetensors"])
    runs = [settings.run_settings("batch of one", seed) for seed in settings.seeds]
    assert [(run.batch, run.accumulate, run.seed) for run in runs] == [(1, 1, seed) for seed in range(5)]
    assert all(run.validation == (settings.target,) for run in runs)


def test_an_initial_checkpoint_of_another_preset_is_refused_by_name(tmp_path: Path) -> None:
    path = write_init(tmp_path / "start.safetensors")
    with pytest.raises(
        CheckpointError, match=r"start.safetensors: holds the 'tiny' network, the settings ask for 'small'"
    ):
        load_initial(path, "small")
    torch.save(uneven_network().state_dict(), tmp_path / "published.pt")
    with pytest.raises(CheckpointError, match=r"published.pt: does not say .* add preset=NAME"):
        load_initial(tmp_path / "published.pt", None)
    assert load_initial(tmp_path / "published.pt", "tiny").preset.name == "tiny"


def test_expected_activations_are_what_autograd_keeps(tmp_path: Path) -> None:
    settings, network = run_settings(tmp_path, tmp_path, tmp_path), uneven_network()
    groups = trained_groups(network, settings.parts)
    expected = expected_memory(network.preset, groups, settings, (28, 42), clips=1)
    set_trainable(network, groups, 2, settings)
    weights = {value.untyped_storage().data_ptr() for value in network.parameters()}
    kept: dict[int, torch.Tensor] = {}

    def keep(value: torch.Tensor) -> torch.Tensor:
        kept[value.untyped_storage().data_ptr()] = value
        return value

    images = torch.rand(1, settings.window.frames, 3, 28, 42)
    with torch.no_grad():
        features = network.encode(images)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
        maps = network.dense(features, images)
    measured = sum(value.untyped_storage().nbytes() for key, value in kept.items() if key not in weights)
    assert maps.depth.requires_grad
    assert expected.parts["activations"] == pytest.approx(measured, rel=0.02)
    assert expected.parts["weights"] == 4 * sum(value.numel() for value in network.state_dict().values())


def test_a_dry_run_prints_settings_groups_and_memory_and_writes_nothing(tmp_path: Path) -> None:
    data, init = write_videos(tmp_path / "videos"), write_init(tmp_path / "start.safetensors")
    out = tmp_path / "out"
    command = [str(CONFIGS / "consistency-small.yaml"), f"data={data}", f"init={init}", f"out={out}", "--dry-run"]
    found = CliRunner().invoke(app, command)
    assert found.exit_code == 0, found.output
    network = uneven_network()
    depth = sum(value.numel() for value in network.depth_head.parameters() if value.ndim >= 2)
    for text in ("steps: 40", f"{depth:,}", "2 videos, 16 frames", "frozen", "activations", "together"):
        assert text in found.output
    assert not out.exists()


def test_a_command_without_a_checkpoint_says_what_to_add(tmp_path: Path) -> None:
    found = CliRunner().invoke(app, [str(CONFIGS / "consistency.yaml"), f"data={tmp_path}"])
    assert found.exit_code == 2
    assert "add init=CHECKPOINT" in found.output

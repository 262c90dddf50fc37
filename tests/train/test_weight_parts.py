"""Weights in parts that fit through a narrow door are the same weights when joined."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from typer.testing import CliRunner

from bathyscope.errors import CheckpointError
from bathyscope_train.model.checkpoints import load_network, save_checkpoint, training_of
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import get_preset
from bathyscope_train.weight_parts import app, join_weights, split_weights


def test_parts_keep_to_their_size_and_join_to_the_same_network(tmp_path: Path) -> None:
    whole = tmp_path / "model.safetensors"
    save_checkpoint(Network(get_preset("tiny")), whole, training={"step": 7})
    parts = split_weights(whole, tmp_path / "parts", limit_mb=4.0)
    assert len(parts) == 4
    assert max(part.stat().st_size for part in parts) <= 4.0e6
    joined = join_weights(tmp_path / "parts", tmp_path / "joined.safetensors")
    before, after = load_file(whole), load_file(joined)
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert training_of(joined)["step"] == 7
    assert load_network(joined)[1].complete


def test_missing_parts_and_tensors_that_fit_nowhere_are_named(tmp_path: Path) -> None:
    whole = tmp_path / "model.safetensors"
    save_checkpoint(Network(get_preset("tiny")), whole, training={})
    with pytest.raises(CheckpointError, match="a part holds"):
        split_weights(whole, tmp_path / "parts", limit_mb=0.01)
    parts = split_weights(whole, tmp_path / "parts", limit_mb=8.0)
    parts[0].unlink()
    with pytest.raises(CheckpointError, match=parts[0].name):
        join_weights(tmp_path / "parts", tmp_path / "joined.safetensors")
    with pytest.raises(CheckpointError, match="no parts"):
        join_weights(tmp_path / "nothing", tmp_path / "joined.safetensors")


def test_the_command_splits_joins_and_says_what_is_wrong(tmp_path: Path) -> None:
    whole, folder = tmp_path / "model.safetensors", tmp_path / "parts"
    save_checkpoint(Network(get_preset("tiny")), whole, training={})
    result = CliRunner().invoke(app, ["split", str(whole), str(folder), "--limit-mb", "9"])
    assert result.exit_code == 0, result.output
    assert result.output.split() == [str(folder / f"model-{k}-of-2.safetensors") for k in (1, 2)]
    assert CliRunner().invoke(app, ["join", str(folder), str(tmp_path / "again.safetensors")]).exit_code == 0
    result = CliRunner().invoke(app, ["join", str(tmp_path / "nothing"), str(tmp_path / "again.safetensors")])
    assert (result.exit_code, "no parts" in result.output) == (2, True)

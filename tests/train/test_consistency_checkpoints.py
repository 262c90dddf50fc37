"""Checkpoints of a run: whole or not at all, and damage is noticed and named."""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from consistency_runs import uneven_network
from safetensors.torch import load_file
from torch import nn

from bathyscope.errors import CheckpointError
from bathyscope_train.consistency import checkpoint_folder
from bathyscope_train.consistency.checkpoint_folder import (
    MODEL,
    OPTIMIZER,
    checkpoint_folders,
    read_last_checkpoint,
    write_checkpoint,
)
from bathyscope_train.consistency.optimizer_state import optimizer_tensors, restore_optimizer
from bathyscope_train.model.checkpoints import load_network

NETWORK = uneven_network()
STATE = {"a/exp_avg": torch.arange(3.0), "a/step": torch.tensor(7.0)}


def write(run: Path, step: int, keep: int = 2) -> Path:
    return write_checkpoint(run, step, NETWORK, STATE, memory={"variation": [1.0]}, keep=keep)


def test_a_checkpoint_comes_back_whole_and_its_weights_load_anywhere(tmp_path: Path) -> None:
    path = write(tmp_path, 3)
    kept = read_last_checkpoint(tmp_path)
    assert kept is not None
    assert (kept.step, kept.memory, kept.average) == (3, {"variation": [1.0]}, None)
    assert all(torch.equal(kept.optimizer[name], value) for name, value in STATE.items())
    assert all(torch.equal(kept.model[name], value) for name, value in NETWORK.state_dict().items())
    assert load_network(path / MODEL)[0].preset == NETWORK.preset


def test_the_oldest_of_more_than_are_kept_goes(tmp_path: Path) -> None:
    for step in (1, 2, 10):
        write(tmp_path, step)
    assert [path.name for path in checkpoint_folders(tmp_path)] == ["step-0000002", "step-0000010"]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond ``size`` bytes: the system refuses, as it does when a disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_write_that_the_system_refuses_leaves_the_last_good_checkpoint(tmp_path: Path) -> None:
    write(tmp_path, 1, keep=1)
    with largest_file(100_000), pytest.raises(CheckpointError, match=r"last good checkpoint is .*step-0000001"):
        write(tmp_path, 2, keep=1)
    kept = read_last_checkpoint(tmp_path)
    assert kept is not None
    assert kept.step == 1
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-0000001"]


def test_a_full_disk_is_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint_folder, "save_file", refuse)
    with pytest.raises(CheckpointError, match=r"the disk is full\); there is no earlier one. Make room"):
        write(tmp_path, 2)
    assert checkpoint_folders(tmp_path) == []


@pytest.mark.parametrize("damage", ["cut", "flipped", "gone", "no position"])
def test_a_damaged_checkpoint_is_refused_and_the_earlier_one_named(tmp_path: Path, damage: str) -> None:
    write(tmp_path, 1)
    last = write(tmp_path, 2)
    if damage == "cut":
        (last / MODEL).write_bytes((last / MODEL).read_bytes()[:-1])
    elif damage == "flipped":
        content = bytearray((last / OPTIMIZER).read_bytes())
        content[-1] ^= 1
        (last / OPTIMIZER).write_bytes(content)
    elif damage == "gone":
        (last / OPTIMIZER).unlink()
    else:
        (last / "position.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"step-0000002: damaged .*remove it to go on from step-0000001"):
        read_last_checkpoint(tmp_path)
    assert len(checkpoint_folders(tmp_path)) == 2


def test_adamw_goes_on_as_if_it_had_not_stopped(tmp_path: Path) -> None:
    def fresh() -> tuple[nn.Linear, torch.optim.AdamW]:
        torch.manual_seed(0)
        layer = nn.Linear(3, 2)
        return layer, torch.optim.AdamW(layer.parameters(), lr=0.1)

    def step(layer: nn.Linear, optimizer: torch.optim.AdamW, times: int) -> None:
        for _ in range(times):
            optimizer.zero_grad()
            layer(torch.ones(1, 3)).square().sum().backward()
            optimizer.step()

    straight = fresh()
    step(*straight, 4)
    first, second = fresh(), fresh()
    step(*first, 2)
    from safetensors.torch import save_file

    save_file(optimizer_tensors(*first), tmp_path / "state.safetensors")
    second[0].load_state_dict(first[0].state_dict())
    restore_optimizer(*second, load_file(tmp_path / "state.safetensors"))
    step(*second, 2)
    assert torch.equal(second[0].weight, straight[0].weight)
    with pytest.raises(CheckpointError, match="other/exp_avg belongs to no parameter"):
        restore_optimizer(*second, {"other/exp_avg": torch.zeros(1)})

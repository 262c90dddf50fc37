"""Checkpoints of a run: folders written beside and renamed, so that a killed run or a full disk leaves the last one.

::

    checkpoints/step-0000200/
        model.safetensors       weights; a checkpoint like any other
        average.safetensors     their running average, where there is one
        optimizer.safetensors   the optimiser's state, ``parameter/field``
        position.json           step and what else the run remembers; size and SHA-256 of the files above
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from bathyscope.bundle import hash_file
from bathyscope.errors import CheckpointError
from bathyscope_train.model.checkpoints import save_checkpoint

FOLDER = "checkpoints"
MODEL, AVERAGE, OPTIMIZER, POSITION = (
    "model.safetensors",
    "average.safetensors",
    "optimizer.safetensors",
    "position.json",
)
_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Kept:
    """What a checkpoint holds."""

    path: Path
    step: int
    model: dict[str, Tensor]
    average: dict[str, Tensor] | None
    optimizer: dict[str, Tensor]
    memory: dict[str, Any]
    """What else the run remembers, as JSON."""


def write_checkpoint(
    run: Path,
    step: int,
    network: nn.Module,
    optimizer: Mapping[str, Tensor],
    *,
    average: Mapping[str, Tensor] | None = None,
    memory: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
    keep: int = 2,
) -> Path:
    """Write a checkpoint whole or not at all; then remove the oldest of more than ``keep``.

    Args:
        run: Folder of the run.
        step: Steps done.
        network: With its weights.
        optimizer: See :func:`~bathyscope_train.consistency.optimizer_state.optimizer_tensors`.
        average: Running average of the weights.
        memory: What else to remember, as JSON.
        training: How the weights came about, kept with them.
        keep: Checkpoints that stay.

    Raises:
        CheckpointError: If it cannot be written; earlier checkpoints are as they were.
    """
    folder = run / FOLDER / f"step-{step:07d}"
    beside = folder.with_name(f".{folder.name}.part")
    if folder.is_dir():
        return folder  # of the same step of the same run, and whole
    try:
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        save_checkpoint(network, beside / MODEL, training=training)
        save_file(dict(optimizer), beside / OPTIMIZER)
        if average is not None:
            save_file({name: value.detach().cpu().contiguous() for name, value in average.items()}, beside / AVERAGE)
        _write_position(beside, step, memory or {})
        beside.replace(folder)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(beside, ignore_errors=True)
        raise CheckpointError(_failure(folder, run, error)) from error
    for old in checkpoint_folders(run)[:-keep]:
        shutil.rmtree(old, ignore_errors=True)
    return folder


def write_weights(path: Path, network: nn.Module, training: Mapping[str, Any]) -> None:
    """Write the weights that a run ends with.

    Raises:
        CheckpointError: If they cannot be written; they are in the last checkpoint too.
    """
    try:
        save_checkpoint(network, path, training=training)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(_failure(path, path.parent, error)) from error


def read_last_checkpoint(run: Path) -> Kept | None:
    """The newest checkpoint of a run; None where there is none.

    Raises:
        CheckpointError: If it is damaged; says what earlier one there is. Nothing is removed.
    """
    folders = checkpoint_folders(run)
    if not folders:
        return None
    *earlier, last = folders
    try:
        return _read(last)
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        instead = f"remove it to go on from {earlier[-1].name}" if earlier else "remove it to start again"
        raise CheckpointError(f"{last}: damaged checkpoint ({error}); {instead}") from error


def checkpoint_folders(run: Path) -> list[Path]:
    """Whole checkpoints, oldest first."""
    return sorted(path for path in (run / FOLDER).glob("step-*") if path.is_dir())


def _write_position(folder: Path, step: int, memory: Mapping[str, Any]) -> None:
    files = {}
    for path in sorted(folder.iterdir()):
        with path.open("rb") as file:
            os.fsync(file.fileno())
        files[path.name] = hash_file(path).model_dump()
    record = {"format": _FORMAT, "step": step, "files": files, "memory": dict(memory)}
    with (folder / POSITION).open("w", encoding="utf-8") as file:
        json.dump(record, file, indent=1)
        file.flush()
        os.fsync(file.fileno())


def _read(folder: Path) -> Kept:
    record = json.loads((folder / POSITION).read_text(encoding="utf-8"))
    if record["format"] != _FORMAT:
        raise ValueError(f"format {record['format']}, this build reads {_FORMAT}")
    for name, stated in record["files"].items():
        path = folder / name
        size = path.stat().st_size
        if size != stated["bytes"]:
            raise ValueError(f"{name} has {size} bytes, {stated['bytes']} were written")
        if hash_file(path).sha256 != stated["sha256"]:
            raise ValueError(f"{name} is not what was written: its SHA-256 differs")
    average = load_file(folder / AVERAGE) if AVERAGE in record["files"] else None
    return Kept(
        folder, int(record["step"]), load_file(folder / MODEL), average, load_file(folder / OPTIMIZER), record["memory"]
    )


def _failure(folder: Path, run: Path, error: Exception) -> str:
    left = checkpoint_folders(run)
    last = f"the last good checkpoint is {left[-1]}" if left else "there is no earlier one"
    full = (isinstance(error, OSError) and error.errno == errno.ENOSPC) or "No space left" in str(error)
    cause = "the disk is full" if full else str(error)
    return f"{folder}: cannot be written ({cause}); {last}. Make room and give the same command again to go on"

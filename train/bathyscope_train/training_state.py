"""A training run on disk: weights, running average, optimiser and position; written whole or not at all."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from bathyscope.errors import CheckpointError
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import NetworkPreset

STATE_FILE = "state.pt"


@dataclass
class Position:
    """Where a run is."""

    step: int = 0
    elapsed_s: float = 0.0


def write_weights(path: Path, network: Network, weights: dict[str, Tensor], provenance: dict[str, Any]) -> None:
    """Write weights as safetensors, with the preset and where they come from in the header."""
    metadata = {"preset": network.preset.model_dump_json(), "provenance": json.dumps(provenance, default=str)}
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    save_file({name: value.detach().contiguous().clone() for name, value in weights.items()}, beside, metadata)
    beside.replace(path)


def read_weights(path: Path) -> Network:
    """The network that :func:`write_weights` wrote, built from the preset in the file's header.

    Raises:
        CheckpointError: If the file is missing, damaged, has no preset or does not fit it.
    """
    try:
        with safe_open(path, framework="pt") as file:
            preset = (file.metadata() or {}).get("preset")
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path}: cannot read the checkpoint: {error}") from error
    if preset is None:
        raise CheckpointError(f"{path}: its header names no preset; only files written by `bathyscope train` do")
    network = Network(NetworkPreset.model_validate_json(preset))
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise CheckpointError(f"{path}: weights do not fit the preset in the header: {error}") from error
    return network


def write_state(
    folder: Path, network: Network, average: dict[str, Tensor], optimizer: torch.optim.Optimizer, position: Position
) -> None:
    """Write everything that is needed to go on."""
    beside = folder / f".{STATE_FILE}.{os.getpid()}"
    state = {
        "network": network.state_dict(),
        "average": average,
        "optimizer": optimizer.state_dict(),
        "step": position.step,
        "elapsed_s": position.elapsed_s,
    }
    torch.save(state, beside)
    beside.replace(folder / STATE_FILE)


def read_state(
    folder: Path, network: Network, average: dict[str, Tensor], optimizer: torch.optim.Optimizer
) -> Position:
    """Go on from :func:`write_state`; a new run starts at step 0.

    Raises:
        CheckpointError: If the state cannot be read or does not fit.
    """
    path = folder / STATE_FILE
    if not path.exists():
        return Position()
    try:
        state = torch.load(path, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        average.update(state["average"])
        return Position(state["step"], state["elapsed_s"])
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot resume from it ({error}); choose another folder or delete it") from error

"""What a training run needs to go on: weights, running average, optimiser, position; written whole or not at all."""

import os
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor

from bathyscope.errors import CheckpointError
from bathyscope_train.model.network import Network

STATE_FILE = "state.pt"


@dataclass
class Position:
    """Where a run is."""

    step: int = 0
    elapsed_s: float = 0.0


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
        state = torch.load(path, weights_only=True, map_location="cpu")
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        average.update({name: value.to(average[name].device) for name, value in state["average"].items()})
        return Position(state["step"], state["elapsed_s"])
    except (OSError, RuntimeError, KeyError, ValueError, UnpicklingError) as error:
        raise CheckpointError(f"{path}: cannot resume from it ({error}); choose another folder or delete it") from error

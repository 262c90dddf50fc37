"""The state of AdamW as named tensors, so that it can be kept in safetensors: no pickle, and readable by eye."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from bathyscope.errors import CheckpointError


def optimizer_tensors(network: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """What the optimiser remembers, as ``parameter/field``; parameters not yet trained have nothing."""
    return {
        f"{name}/{field}": value.detach().cpu().contiguous()
        for name, parameter in network.named_parameters()
        if parameter in optimizer.state
        for field, value in optimizer.state[parameter].items()
    }


def restore_optimizer(network: nn.Module, optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Give the optimiser back what :func:`optimizer_tensors` read off.

    Raises:
        CheckpointError: If a tensor belongs to no trained parameter, or is of another shape.
    """
    trained = {parameter for group in optimizer.param_groups for parameter in group["params"]}
    parameters = {name: value for name, value in network.named_parameters() if value in trained}
    for key, value in tensors.items():
        name, _, field = key.rpartition("/")
        parameter = parameters.get(name)
        if parameter is None:
            raise CheckpointError(f"the optimiser's {key} belongs to no parameter that is trained now")
        if field != "step" and value.shape != parameter.shape:
            raise CheckpointError(f"the optimiser's {key} has shape {tuple(value.shape)}, not {tuple(parameter.shape)}")
        # AdamW counts steps on the CPU, whatever the device of the parameter
        optimizer.state[parameter][field] = value if field == "step" else value.to(parameter.device)

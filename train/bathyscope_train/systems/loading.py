"""Published weights into a network whose parameters have the published names: every key, nothing guessed."""

from collections.abc import Callable

import torch
from torch import nn

from bathyscope.errors import CheckpointError
from bathyscope_train.model.weight_files import WeightFile
from bathyscope_train.systems.kinds import bare


def load_exactly(
    network: nn.Module, weights: WeightFile, what: str, *, ignored: Callable[[str], bool] = lambda key: False
) -> None:
    """Copy the tensors of a file into ``network``, in the network's own precision.

    Args:
        network: Takes exactly what the file holds.
        weights: The file; ``module.`` and ``model.`` before its keys are dropped.
        what: What the file should be, for messages.
        ignored: Which keys of the file the network has no use for.

    Raises:
        CheckpointError: If a tensor is missing, unknown, of another shape or kind, or not finite.
    """
    wanted = network.state_dict()
    stored = {bare(key): key for key in weights.shapes if not ignored(bare(key))}
    missing, unknown = sorted(wanted.keys() - stored.keys()), sorted(stored.keys() - wanted.keys())
    other = [name for name in wanted if name in stored and weights.shapes[stored[name]] != tuple(wanted[name].shape)]
    for problem, names in (("lacks", missing), ("has besides", unknown), ("has in another shape", other)):
        if names:
            raise CheckpointError(
                f"{weights.path}: is no {what}: it {problem} {len(names)} of {len(wanted)} tensors, first {names[0]}"
                + _shapes(names[0], weights, stored, wanted)
            )
    with torch.no_grad():
        for name, target in wanted.items():
            value = weights.read(stored[name])
            if value.is_floating_point() != target.is_floating_point():
                raise CheckpointError(f"{weights.path}: {stored[name]} is {value.dtype}, {target.dtype} was needed")
            if value.is_floating_point() and not torch.isfinite(value).all():
                raise CheckpointError(f"{weights.path}: {stored[name]} holds values that are not finite numbers")
            target.copy_(value)


def _shapes(name: str, weights: WeightFile, stored: dict[str, str], wanted: dict[str, torch.Tensor]) -> str:
    if name not in stored or name not in wanted:
        return ""
    return f" ({weights.shapes[stored[name]]}, {tuple(wanted[name].shape)} was needed)"

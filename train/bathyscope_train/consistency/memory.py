"""How much memory a run will take, from the network's own operations: nothing is computed, only shapes are followed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.multiprocessing.reductions import StorageWeakRef

from bathyscope_train.consistency.clip_step import TRUNK, checkpoint_blocks
from bathyscope_train.consistency.geometry import dense_maps, encode
from bathyscope_train.consistency.parts import Group
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import NetworkPreset

FLOAT = 4
"""Bytes of a number."""
_GAUSSIAN_FLOATS = 3 + 4 + 3 + 1
"""Mean, rotation, scales and opacity; colour comes on top."""
_PLANES = 5
"""Opacity, depth and colour of a rendered view."""


@dataclass(frozen=True, slots=True)
class Memory:
    """Bytes by what they are for."""

    parts: Mapping[str, int]

    @property
    def total(self) -> int:
        """Of all parts."""
        return sum(self.parts.values())


def expected_memory(
    preset: NetworkPreset, groups: list[Group], settings: ConsistencySettings, size: tuple[int, int], clips: int
) -> Memory:
    """What is held at the same time when a step goes back; without what torch itself, workers and kernels take.

    Activations are the tensors that autograd keeps of transformer and dense heads, in float32 (the transformer's
    matrix products take half of it in bfloat16). Of the camera head nothing is counted: the small one solves for a few
    hundred points, and the large one reads one token a frame.

    Args:
        preset: Of the network.
        groups: What is ever trained.
        settings: Of the run.
        size: Height and width of the frames.
        clips: Windows that are worked on at once.
    """
    with FakeTensorMode():
        network = Network(preset)
        activations = _activations(network, settings, size, clips)
    everything = sum(value.numel() for value in network.state_dict().values())
    numbers = {name: value.numel() for name, value in network.named_parameters()}
    trained = sum(numbers[name] for group in groups for name in group.names)
    trunk = any(group.part.startswith(TRUNK) for group in groups)
    kept = everything - (0 if trunk else _of_part(numbers, TRUNK)) - _of_part(numbers, "gaussian_param_head")
    frames = clips * settings.window.frames
    gaussians = frames * size[0] * size[1] if preset.gaussians is not None else 0
    views = frames * (2 if settings.loss.image.weight > 0 and settings.loss.image.views == "others" else 1)
    colour = 3 * (preset.harmonic_degree + 1) ** 2
    parts = {
        "weights": everything,
        "heads before training": kept,
        "gradients": trained,
        "AdamW": 2 * trained,
        "running average": everything if settings.ema_decay > 0 else 0,
        "frames": frames * 3 * size[0] * size[1],
        "activations": activations // FLOAT,
        # the scene itself, its gradient, and once more while each is put together
        "Gaussians": 4 * gaussians * (_GAUSSIAN_FLOATS + colour),
        "rendered views": 2 * views * _PLANES * size[0] * size[1] if gaussians else 0,
    }
    return Memory({name: FLOAT * floats for name, floats in parts.items() if floats})


def _activations(network: Network, settings: ConsistencySettings, size: tuple[int, int], clips: int) -> int:
    """Bytes that autograd keeps of transformer and dense heads, each storage once and without the weights."""
    for name, value in network.named_parameters():
        value.requires_grad_(any(name.startswith(part) and each.rate > 0 for part, each in settings.parts.items()))
    trunk = any(value.requires_grad for value in network.aggregator.parameters())
    if trunk and settings.checkpoint_activations:
        checkpoint_blocks(network)
    images = torch.zeros(clips, settings.window.frames, 3, *size)
    return saved_bytes(
        network.parameters(),
        lambda: dense_maps(network, encode(network, images, trained=trunk), images, settings.dense_chunk),
    )


def saved_bytes(parameters: Iterable[Tensor], forward: Callable[[], object]) -> int:
    """Bytes that autograd keeps of a call, each storage once and without that of ``parameters``."""
    kept: dict[StorageWeakRef, int] = {}

    def keep(value: Tensor) -> Tensor:
        kept[StorageWeakRef(value.untyped_storage())] = value.untyped_storage().nbytes()
        return value

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda value: value):
        result = forward()
    own = {StorageWeakRef(value.untyped_storage()) for value in parameters}
    del result  # until here it held what was kept
    return sum(size for storage, size in kept.items() if storage not in own)


def _of_part(numbers: Mapping[str, int], part: str) -> int:
    return sum(count for name, count in numbers.items() if name.startswith(part))

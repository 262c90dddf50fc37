"""How much memory a run on a video network will take; see :mod:`~bathyscope_train.consistency.memory`."""

from __future__ import annotations

import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from bathyscope_train.consistency.memory import FLOAT, Memory, saved_bytes
from bathyscope_train.consistency.parts import Group
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import VdaSettings
from bathyscope_train.systems.vda.training import VdaGeometry


def expected_video_memory(
    sizes: VdaSettings, groups: list[Group], settings: ConsistencySettings, size: tuple[int, int], clips: int
) -> Memory:
    """What is held at the same time when a step goes back, without the system that gives the cameras.

    Args:
        sizes: Of the network.
        groups: What is ever trained.
        settings: Of the run.
        size: Height and width of the frames.
        clips: Windows that are worked on at once.
    """
    with FakeTensorMode():
        network = VideoDepthAnything(sizes)
        for name, value in network.named_parameters():
            value.requires_grad_(any(name in group.names for group in groups))
        images = torch.zeros(clips, settings.window.frames, 3, *size)
        module = VdaGeometry(network)
        activations = saved_bytes(network.parameters(), lambda: module.values(images))
    everything = sum(value.numel() for value in network.state_dict().values())
    numbers = {name: value.numel() for name, value in network.named_parameters()}
    trained = sum(numbers[name] for group in groups for name in group.names)
    parts = {
        "weights": everything,
        "network before training": everything,
        "gradients": trained,
        "AdamW": 2 * trained,
        "running average": everything if settings.ema_decay > 0 else 0,
        "frames": images.numel(),
        "activations": activations // FLOAT,
    }
    return Memory({name: FLOAT * floats for name, floats in parts.items() if floats})

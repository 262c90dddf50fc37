"""What EndoDAV trains: adapters in the encoder and, in turn with them, in the temporal modules.

Published: clips of 16 frames at 256x320, one a batch. All else of the temporal modules stays frozen. While their
adapters train, :mod:`bathyscope_train.losses.endodav` adds to the losses taken over from EndoDAC.
"""

from typing import Literal

from torch import nn

from bathyscope_train.systems.depth_anything.adapters import adapter_parameters
from bathyscope_train.systems.depth_anything.schedule import WARM_UP, adapter_letters, added_parameters, train_only
from bathyscope_train.systems.endodav.head import SigmoidVideoHead
from bathyscope_train.systems.endodav.network import EndoDav
from bathyscope_train.systems.endodav.settings import EndoDavSettings

SPATIAL_STEPS, TEMPORAL_STEPS = 400, 100
"""Steps of a turn, where the temporal modules have adapters."""

CLIP_FRAMES = 16


def turn(settings: EndoDavSettings, step: int) -> Literal["spatial", "temporal"]:
    """Whose turn it is at ``step``: always the spatial parts' where the temporal modules have no adapters."""
    if not settings.temporal_adapter:
        return "spatial"
    return "spatial" if step % (SPATIAL_STEPS + TEMPORAL_STEPS) < SPATIAL_STEPS else "temporal"


def parameters(network: EndoDav, step: int, *, warm_up: int = WARM_UP) -> list[nn.Parameter]:
    """Freeze everything but what trains at ``step``, and return that.

    In a spatial turn these are the encoder's adapters and necks and, if the head is EndoDAC's, its output layers; in a
    temporal one the temporal modules' adapters. DV-LoRA's two phases are EndoDAC's.
    """
    settings = network.settings
    letters = adapter_letters(settings.adapter, step, warm_up=warm_up)
    if turn(settings, step) == "temporal":
        return train_only([network], adapter_parameters(network.head.motion_modules, letters))
    trained = list(added_parameters(network.pretrained, letters))
    if isinstance(network.head, SigmoidVideoHead):
        trained += [value for layer in network.head.output_layers for value in layer.parameters()]
    return train_only([network], trained)

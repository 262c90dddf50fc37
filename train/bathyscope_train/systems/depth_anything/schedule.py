"""What the papers train of an adapted network, and when."""

from collections.abc import Iterable, Iterator

from torch import nn

from bathyscope_train.systems.depth_anything.adapters import AdapterKind, adapter_parameters
from bathyscope_train.systems.depth_anything.neck import Neck

WARM_UP = 20_000
"""Steps after which DV-LoRA's A and B are frozen and its U and V train."""


def adapter_letters(kind: AdapterKind | None, step: int, *, warm_up: int = WARM_UP) -> str:
    """Which of the adapters' parameters train at ``step``: A and B, or from ``warm_up`` on DV-LoRA's U and V."""
    if kind is None:
        return ""
    return "UV" if kind == "dvlora" and step >= warm_up else "AB"


def added_parameters(encoder: nn.Module, letters: str) -> Iterator[nn.Parameter]:
    """Parameters of the encoder's adapters (see :func:`adapter_letters`) and of its necks."""
    yield from adapter_parameters(encoder, letters)
    for module in encoder.modules():
        if isinstance(module, Neck):
            yield from module.parameters()


def train_only(networks: Iterable[nn.Module], trained: Iterable[nn.Parameter]) -> list[nn.Parameter]:
    """Freeze every parameter of ``networks`` but ``trained``; returns those, for an optimiser."""
    chosen = list(trained)
    for network in networks:
        network.requires_grad_(False)
    for parameter in chosen:
        parameter.requires_grad_(True)
    return chosen

"""What is trained, how fast, and from when on: functions of the settings and the step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import nn

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.settings import ConsistencySettings, PartSettings
from bathyscope_train.schedule import learning_rate_factor


@dataclass(frozen=True, slots=True)
class Group:
    """Parameters that are trained alike."""

    part: str
    settings: PartSettings
    decayed: bool
    names: tuple[str, ...]


def learning_rate(step: int, settings: ConsistencySettings) -> float:
    """Linear warm-up, then a cosine from the peak to its final share at the last step.

    Step 0 already moves by ``peak / (warmup_steps + 1)``.
    """
    after = max(settings.steps - settings.warmup_steps, 1)
    progress = (step - settings.warmup_steps) / after
    factor = learning_rate_factor(step, progress, warmup_steps=settings.warmup_steps, floor=settings.final_lr)
    return settings.peak_lr * factor


def trained_groups(network: nn.Module, parts: Mapping[str, PartSettings]) -> list[Group]:
    """The parameters that are ever trained; matrices and kernels, which alone decay, apart.

    Args:
        network: Whose parameters are named.
        parts: By the beginning of the names; the longest that fits counts.

    Raises:
        SettingsError: If a part names no parameter.
    """
    found: dict[tuple[str, bool], list[str]] = {}
    seen = set()
    for name, parameter in network.named_parameters():
        part = max((part for part in parts if name.startswith(part)), key=len, default=None)
        if part is None:
            continue
        seen.add(part)
        if parts[part].rate > 0:
            decayed = parameter.ndim >= 2 and "token" not in name.rpartition(".")[2]
            found.setdefault((part, decayed), []).append(name)
    _check_named(network, parts, seen)
    return [Group(part, parts[part], decayed, tuple(names)) for (part, decayed), names in found.items()]


def _check_named(network: nn.Module, parts: Mapping[str, PartSettings], seen: set[str]) -> None:
    """A part that the network has not is an error, unless it is one of the heads that a preset may do without."""
    known = sorted({name.split(".")[0] for name, _ in network.named_parameters()})
    for part in parts:
        if part not in seen and not (part == "gaussian_param_head" and part not in known):
            raise SettingsError(f"no parameter of the network begins with {part!r}; its parts are {', '.join(known)}")


def is_active(part: PartSettings, step: int, settings: ConsistencySettings) -> bool:
    """Whether a part is trained at a step."""
    return part.rate > 0 and not (part.after_warmup and step < settings.warmup_steps)


def set_trainable(network: nn.Module, groups: list[Group], step: int, settings: ConsistencySettings) -> frozenset[str]:
    """Freeze everything but what is trained at ``step``; returns the parts that are.

    A frozen parameter has no gradient at all, so that neither momentum nor decay moves it.
    """
    active = {name: group.part for group in groups if is_active(group.settings, step, settings) for name in group.names}
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(name in active)
        if name not in active:
            parameter.grad = None
    return frozenset(active.values())


def optimizer_groups(network: nn.Module, groups: list[Group], settings: ConsistencySettings) -> list[dict[str, Any]]:
    """What AdamW takes: one group of parameters after the other, in the order of ``groups``."""
    parameters = dict(network.named_parameters())
    return [
        {
            "params": [parameters[name] for name in group.names],
            "lr": 0.0,
            "weight_decay": settings.weight_decay if group.decayed else 0.0,
        }
        for group in groups
    ]

"""Rays that still have work to do, moved together: the only place where the host waits for the device."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

State = tuple[Tensor, ...]


def compact(mask: Bool[Tensor, "s n"]) -> tuple[Int[Tensor, "s k"], Bool[Tensor, "s k"]]:
    """Indices of the marked rays of every scene, in order, and which of them are no filling.

    k is the largest number of marked rays of a scene; filling points at the scene's first ray.
    """
    count = mask.sum(1, keepdim=True)
    width = int(count.max())
    place = torch.where(mask, mask.cumsum(1) - 1, width)
    index = torch.zeros((len(mask), width + 1), dtype=torch.int64, device=mask.device)
    index.scatter_(1, place, torch.arange(mask.shape[1], device=mask.device).expand(mask.shape))
    return index[:, :width], torch.arange(width, device=mask.device) < count


def pick(values: Tensor, index: Int[Tensor, "s k"]) -> Tensor:
    """Values ``(s, n)`` or ``(3, s, n)`` of the rays ``index``."""
    return values.gather(-1, index.expand(*values.shape[:-2], *index.shape))


def put(values: Tensor, index: Int[Tensor, "s k"], present: Bool[Tensor, "s k"], new: Tensor) -> Tensor:
    """A copy of values ``(..., s, n)`` with ``new`` ``(..., s, k)`` at the rays ``index`` that are present."""
    rays = values.shape[-1]
    spare = torch.cat([values, values[..., :1]], -1)
    target = torch.where(present, index, rays).expand(new.shape)
    return spare.scatter(-1, target, new)[..., :rays]


def repeat_in_rounds(
    step: Callable[[State, State, int], State],
    unfinished: Callable[[State], Bool[Tensor, "s n"]],
    fixed: State,
    state: State,
    rounds: Sequence[int],
) -> State:
    """Repeat ``step`` on rays until none is unfinished or the rounds are over.

    Between rounds the unfinished rays are moved together, so that few rays that need many steps cost little.

    Args:
        step: From what is fixed, the state and the step's number to the next state; must leave finished rays alone.
        unfinished: Which rays of a state go on.
        fixed: Tensors ``(s, n)`` or ``(3, s, n)`` that do not change.
        state: Tensors ``(s, n)``.
        rounds: Steps of each round.
    """
    number = 0
    for steps in rounds:
        if number == 0:
            index, present, part_fixed, part = None, None, fixed, state
        else:
            index, present = compact(unfinished(state))
            if index.shape[1] == 0:
                return state
            part_fixed, part = (tuple(pick(values, index) for values in group) for group in (fixed, state))
        for _ in range(steps):
            part = step(part_fixed, part, number)
            number += 1
        if index is None or present is None:
            state = part
        else:
            state = tuple(put(values, index, present, new) for values, new in zip(state, part, strict=True))
    return state

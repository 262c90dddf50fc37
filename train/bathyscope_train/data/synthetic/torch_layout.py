"""How rays and what they need lie in memory: rows of rays, values a row, maps in tables, rays moved together.

A row is one frame of one clip. Rays are ``(s, n)``: n rays of each of s rows. What holds for a whole row ends in
``(s, 1)`` and meets its rays without being copied. When only some rays go on, they move into a single long row, and
what they need is copied to each of them (:func:`spread`): then there are no idle rays, whichever rows they come from.
Moving is the only place where the host waits for the device.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Part = TypeVar("Part")
Result = TypeVar("Result")
State = tuple[Tensor, ...]

_BACKEND = "inductor"
_VARIANTS = 32  # kinds of surface, with and without films, swelling, a second light ...


@dataclass(frozen=True, slots=True)
class Atlas:
    """Maps of different sizes, one a row, in one table."""

    table: Float[Tensor, "m c"]
    """The maps' samples, row by row."""
    first: Int[Tensor, "s 1"]
    """Where in the table the map begins."""
    rows: Int[Tensor, "s 1"]
    columns: Int[Tensor, "s 1"]

    def at(self, i: Int[Tensor, "s n"], j: Int[Tensor, "s n"]) -> Float[Tensor, "s n c"]:
        """What the maps hold at row i and column j."""
        index = self.first + i * self.columns + j
        return self.table.index_select(0, index.flatten()).view(*index.shape, -1)


@dataclass(frozen=True, slots=True)
class Chosen:
    """Some rays."""

    index: Int[Tensor, "k"]
    """Counted row by row."""
    rows: Int[Tensor, "k"]

    def repeat(self, times: int) -> "Chosen":
        """The same rays several times over."""
        return Chosen(self.index.repeat(times), self.rows.repeat(times))


def marked(mask: Bool[Tensor, "s n"]) -> Chosen:
    """The marked rays."""
    index = mask.flatten().nonzero()[:, 0]
    return Chosen(index, index // mask.shape[1])


def pick(values: Tensor, chosen: Chosen) -> Tensor:
    """Values of some rays, ``(..., 1, k)``, from those of all, ``(..., s, n)``, or of whole rows, ``(..., s, 1)``."""
    if values.shape[-1] == 1:
        return values[..., 0].index_select(-1, chosen.rows).unsqueeze(-2)
    return values.flatten(-2).index_select(-1, chosen.index).unsqueeze(-2)


def put(values: Tensor, chosen: Chosen, new: Tensor) -> Tensor:
    """A copy of ``(..., s, n)`` with ``new``, ``(..., 1, k)``, at some rays."""
    flat = values.flatten(-2).index_copy(-1, chosen.index, new.squeeze(-2))
    return flat.view(values.shape)


def spread(part: Part, chosen: Chosen) -> Part:
    """``pick`` of everything in a dataclass or tuple, and in theirs; the tables of maps stay."""
    if isinstance(part, Tensor):
        return cast(Part, pick(part, chosen))
    if isinstance(part, tuple):
        return cast(Part, tuple(spread(one, chosen) for one in part))
    if is_dataclass(part) and not isinstance(part, type):
        names = [field.name for field in fields(part) if field.name != "table"]
        values = {name: spread(getattr(part, name), chosen) for name in names}
        return cast(Part, replace(cast(Any, part), **values))
    return part


def everything(rows: int, rays: int, device: torch.device) -> Chosen:
    """All rays of all rows."""
    index = torch.arange(rows * rays, device=device)
    return Chosen(index, index // rays)


@cache
def compiled(function: Callable[..., Result]) -> Callable[..., Result]:
    """The function as ``torch.compile`` makes it on its first call, for rays of any number."""
    config = torch._dynamo.config
    config.recompile_limit = max(config.recompile_limit, _VARIANTS)
    return cast(Callable[..., Result], torch.compile(function, dynamic=True, backend=_BACKEND))


def repeat_in_rounds(
    step: Callable[[Part, State, State, int], State],
    unfinished: Callable[[State], Bool[Tensor, "s n"]],
    part: Part,
    fixed: State,
    state: State,
    *,
    rounds: Sequence[int],
) -> State:
    """Repeat ``step`` on rays until none is unfinished or the rounds are over.

    Between rounds the unfinished rays are moved together, so that few rays that need many steps cost little.

    Args:
        step: From what holds for the rows, what is fixed, the state and the step's number to the next state; must
            leave finished rays alone.
        unfinished: Which rays of a state go on.
        part: What holds for whole rows.
        fixed: Tensors ``(..., s, n)`` or ``(..., s, 1)`` that do not change.
        state: Tensors ``(s, n)``.
        rounds: Steps of each round.
    """
    number = 0
    for steps in rounds:
        if number == 0:
            for _ in range(steps):
                state = step(part, fixed, state, number)
                number += 1
            continue
        chosen = marked(unfinished(state))
        if len(chosen.index) == 0:
            break
        moved, some_fixed, some = spread((part, fixed, state), chosen)
        for _ in range(steps):
            some = step(moved, some_fixed, some, number)
            number += 1
        state = tuple(put(values, chosen, new) for values, new in zip(state, some, strict=True))
    return state

"""Solids in torch: what ``solid_tracing`` does a ray at a time, for the rays ``(s, n)`` of s rows at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bathyscope_train.data.synthetic.solid_tracing import NEVER
from bathyscope_train.data.synthetic.solids import BALL, BOX, FRUSTUM, ROOM, Solids
from bathyscope_train.data.synthetic.torch_layout import Atlas

Points = Float[Tensor, "3 s n"]
Values = Float[Tensor, "s n"]

_FLAT = 1e-12


@dataclass(frozen=True, slots=True)
class Shapes:
    """The solids of one shape: of every row equally many, the last ones of some rows filling."""

    table: Float[Tensor, "m c s"]
    """``local_from_scene`` (12), ``size`` (3), and the solid's number, -1 for filling."""
    row: Int[Tensor, "s 1"]

    def __len__(self) -> int:
        return len(self.table)

    def of(self, m: int) -> tuple[Float[Tensor, "3 4 s n"], Points, Values]:
        """Frame, size and number of the m-th solid of each row."""
        values = self.table[m].index_select(-1, self.row.flatten()).view(-1, *self.row.shape)
        return values[:12].unflatten(0, (3, 4)), values[12:15], values[15]


@dataclass(frozen=True, slots=True)
class SolidTensors:
    """See :class:`~bathyscope_train.data.synthetic.solids.Solids`."""

    boxes: Shapes
    rooms: Shapes
    frusta: Shapes
    balls: Shapes
    every: Atlas
    """A column of all solids of a row: kind, mover, ``local_from_scene`` (12), ``size`` (3), ``look`` (12)."""
    patterns: tuple[int, ...]
    """Those in use."""
    lights: Float[Tensor, "l 4 s 1"]
    """Filling has no light."""
    reach_mm: Float[Tensor, "s 1"]
    sky: Float[Tensor, "s 1"]
    lamp_share: Float[Tensor, "s 1"]


def solid_tensors(rows: Sequence[Solids], device: torch.device | str, dtype: torch.dtype) -> SolidTensors:
    """Put the solids of every row on a device."""

    def tensor(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)

    def shapes(kind: int) -> Shapes:
        chosen = [np.flatnonzero(solids.kind == kind) for solids in rows]
        table = np.zeros((max(len(one) for one in chosen), 16, len(rows)))
        table[:, 15] = -1
        for row, (solids, numbers) in enumerate(zip(rows, chosen, strict=True)):
            for m, number in enumerate(numbers):
                local = solids.local_from_scene[number].ravel()
                table[m, :, row] = [*local, *solids.size[number], number]
        return Shapes(tensor(table), torch.arange(len(rows), device=device)[:, None])

    numbers = [np.column_stack([s.kind, s.mover, s.local_from_scene.reshape(-1, 12), s.size, s.look]) for s in rows]
    counts = torch.tensor([len(one) for one in numbers], device=device)[:, None]
    lights = np.zeros((max(len(solids.lights) for solids in rows), 4, len(rows)))
    for row, solids in enumerate(rows):
        lights[: len(solids.lights), :, row] = solids.lights
    return SolidTensors(
        boxes=shapes(BOX),
        rooms=shapes(ROOM),
        frusta=shapes(FRUSTUM),
        balls=shapes(BALL),
        every=Atlas(tensor(np.concatenate(numbers)), counts.cumsum(0) - counts, counts, torch.ones_like(counts)),
        patterns=tuple(sorted({int(pattern) for solids in rows for pattern in solids.look[:, 6]})),
        lights=tensor(lights)[..., None],
        reach_mm=tensor(np.array([[solids.reach_mm] for solids in rows])),
        sky=tensor(np.array([[solids.sky] for solids in rows])),
        lamp_share=tensor(np.array([[solids.lamp_share] for solids in rows])),
    )


def trace_solids(
    solids: SolidTensors, start: Values, end: Values, origin: Points, direction: Points
) -> tuple[Values, Int[Tensor, "s n"]]:
    """Distance to the first solid between ``start`` and ``end`` along unit rays, and its number (-1: none)."""
    best = end.expand_as(direction[0])
    which = torch.full_like(best, -1)
    meetings: tuple[tuple[Shapes, Callable[[Points, Values, Points, Points], Values]], ...] = (
        (solids.boxes, _box),
        (solids.rooms, _room),
        (solids.frusta, _frustum),
        (solids.balls, _ball),
    )
    for shapes, meet in meetings:
        for m in range(len(shapes)):
            local, size, number = shapes.of(m)
            p = (local[:, :3] * origin).sum(1) + local[:, 3]
            q = (local[:, :3] * direction).sum(1)
            t = meet(size, start, p, q)
            wins = (number >= 0) & ((t < best) | ((t == best) & (number < which)))
            best, which = torch.where(wins, t, best), torch.where(wins, number, which)
    return best, which.long()


def _slabs(half: Points, p: Points, q: Points) -> tuple[Values, Values]:
    """Where rays enter and leave a box; they miss it if they leave before they enter."""
    q = torch.where(q.abs() < _FLAT, _FLAT, q)
    first, second = (-half - p) / q, (half - p) / q
    return torch.minimum(first, second).amax(0), torch.maximum(first, second).amin(0)


def _box(half: Points, start: Values, p: Points, q: Points) -> Values:
    enter, leave = _slabs(half, p, q)
    return torch.where((leave >= enter) & (enter > start), enter, NEVER)


def _room(half: Points, start: Values, p: Points, q: Points) -> Values:
    enter, leave = _slabs(half, p, q)
    return torch.where((leave >= enter) & (leave > start), leave, NEVER)


def _ball(size: Points, start: Values, p: Points, q: Points) -> Values:
    b = (p * q).sum(0)
    nearest = p - b * q  # its distance from the centre, not that of p, keeps single precision's digits
    gap = size[0].square() - nearest.square().sum(0)
    t = -b - gap.clamp_min(0).sqrt()
    return torch.where((gap >= 0) & (t > start), t, NEVER)


def _frustum(size: Points, start: Values, p: Points, q: Points) -> Values:
    low, high, half = size
    half = half.clamp_min(_FLAT)  # of filling
    middle, slope = 0.5 * (low + high), 0.5 * (high - low) / half
    a = q[0].square() + q[1].square() - (slope * q[2]).square()
    b = p[0] * q[0] + p[1] * q[1] - slope * q[2] * (middle + slope * p[2])
    a = torch.where(a.abs() < _FLAT, _FLAT, a)
    closest = -b / a
    x, y, z = p + closest * q
    gap = ((middle + slope * z).square() - x.square() - y.square()) / a
    root = gap.clamp_min(0).sqrt()
    best = torch.full_like(b, NEVER)
    for sign in (-1.0, 1.0):
        t = closest + sign * root
        z = p[2] + t * q[2]
        hit = (gap >= 0) & (t > start) & (z.abs() <= half) & (middle + slope * z >= 0)
        best = torch.where(hit & (t < best), t, best)
    steep = torch.where(q[2].abs() < _FLAT, _FLAT, q[2])
    for sign, radius in ((-1.0, low), (1.0, high)):
        t = (sign * half - p[2]) / steep
        across = (p[:2] + t * q[:2]).square().sum(0)
        best = torch.where((t > start) & (across <= radius.square()) & (t < best), t, best)
    return best

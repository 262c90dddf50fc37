"""Tracing in torch: what ``tracing`` does a ray at a time, for the rays ``(s, n)`` of s rows at once.

Points and directions are ``(3, s, n)``. Both renderers take the same steps, so that they find the same surface.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.synthetic.scene import BLOCK, TUBE
from bathyscope_train.data.synthetic.torch_layout import State, compiled, repeat_in_rounds
from bathyscope_train.data.synthetic.torch_scene import SurfaceTensors
from bathyscope_train.data.synthetic.tracing import CLOSE_MM, FARTHEST_MM, REFINEMENTS

_MARCH = (16,) * 32  # steps of a round: 20 in the mean, 130 at most in 12 000 rays of three families
_REFINE = (6, 6, REFINEMENTS - 12)

Points = Float[Tensor, "3 s n"]
Values = Float[Tensor, "s n"]


def place(surface: SurfaceTensors, points: Points) -> tuple[Values, Values, Values]:
    """Row, column and reach of points; reach is the radius in a tube and the depth over a field."""
    if surface.kind != TUBE:
        x, y, z = points
        return (y - surface.first[0]) * surface.density[0], (x - surface.first[1]) * surface.density[1], z
    row, dx, dy = _out(surface, points)
    a = dy / (dx.abs() + dy.abs() + 1e-12)
    a = torch.where(dx < 0, 2 - a, torch.where(dy < 0, 4 + a, a))
    return row, a * surface.density[1], torch.sqrt(dx * dx + dy * dy)


def _out(surface: SurfaceTensors, points: Points) -> tuple[Values, Values, Values]:
    """Row of points in a tube, and the way to them from its centreline, x and y."""
    x, y, z = points
    row = (z - surface.first[0]) * surface.density[0]
    i = torch.minimum(row.long().clamp_min(0), surface.centre.rows - 1)
    segment = surface.centre.at(i, torch.zeros_like(i))
    middle = torch.lerp(segment[..., :2], segment[..., 2:], (row - i).clamp(0, 1)[..., None])
    return row, x - middle[..., 0], y - middle[..., 1]


def at_rest(surface: SurfaceTensors, points: Points) -> Points:
    """Where points of swollen tissue are while it rests."""
    if surface.waves is None:
        return points
    x, y, z = points
    amplitude, k_along, k_across, phase = surface.waves
    if surface.kind != TUBE:
        return torch.stack([x, y, z - (amplitude * torch.cos(k_along * y + k_across * x + phase)).sum(0)])
    _, dx, dy = _out(surface, points)
    gain = (amplitude * torch.cos(k_along * z + k_across * torch.atan2(dy, dx) + phase)).sum(0)
    share = gain / torch.sqrt(dx * dx + dy * dy).clamp_min(1e-9)
    return torch.stack([x - share * dx, y - share * dy, z])


def free_depth(surface: SurfaceTensors, points: Points) -> Values:
    """Positive in free space, zero on the surface; for a tube the distance to the wall within the slice."""
    return _free(surface, *place(surface, points))


def _free(surface: SurfaceTensors, row: Values, column: Values, reach: Values) -> Values:
    """``free_depth`` of places."""
    i = torch.minimum(row.long().clamp_min(0), surface.cells.rows - 1)
    j = torch.minimum(column.long().clamp_min(0), surface.cells.columns - 1)
    s, t = row - i, column - j
    if surface.kind == TUBE:
        closed = column >= surface.columns  # by rounding: the angle of a full turn
        j, t = torch.where(closed, 0, j), torch.where(closed, column - surface.columns, t)
    corners = surface.cells.at(i, j)
    edges = torch.lerp(corners[..., :2], corners[..., 2:], s[..., None])
    gap = torch.lerp(edges[..., 0], edges[..., 1], t) - reach
    if surface.kind != TUBE:
        gap = torch.where((column < 0) | (column > surface.columns - 1), -1.0, gap)
    return torch.where((row < 0) | (row > surface.rows - 1), -1 - reach, gap)


def trace(surface: SurfaceTensors, start: Values, origin: Points, direction: Points) -> Values:
    """Distance along unit rays to the surface, looked for from ``start``."""
    march, refine = (compiled(_march), compiled(_refine)) if surface.compiled else (_march, _refine)
    fixed = (origin, direction)
    free = free_depth(surface, origin + start * direction)
    before = surface.stride_mm.expand_as(start)
    state: State = (torch.zeros_like(start), start, before, free, torch.zeros_like(start))
    near, far, before, free, _ = repeat_in_rounds(march, _in_the_open, surface, fixed, state, rounds=_MARCH)
    near, far, _, _ = repeat_in_rounds(refine, _apart, surface, fixed, (near, far, before, free), rounds=_REFINE)
    return 0.5 * (near + far)


def _in_the_open(state: State) -> Tensor:
    return (state[3] > 0) & (state[1] < FARTHEST_MM)


def _march(surface: SurfaceTensors, fixed: State, state: State, _: int) -> State:
    """One step towards the surface."""
    origin, direction = fixed
    near, t, before, free, leap = state
    active = _in_the_open(state)
    stride = surface.stride_mm
    step = torch.maximum(
        torch.maximum(torch.minimum(0.7 * free, stride), 0.2 * stride), torch.minimum(0.5 * leap, surface.leap_mm)
    )
    ahead = t + step
    row, column, reach = place(surface, origin + ahead * direction)
    found = _free(surface, row, column, reach)
    i = torch.minimum((row.long() // BLOCK).clamp_min(0), surface.core.rows - 1)
    if surface.kind == TUBE:
        j = torch.zeros_like(i)
    else:
        j = torch.minimum((column.long() // BLOCK).clamp_min(0), surface.core.columns - 1)
    core = surface.core.at(i, j)[..., 0] - surface.rise_mm - reach
    return (
        torch.where(active, t, near),
        torch.where(active, ahead, t),
        torch.where(active, free, before),
        torch.where(active, found, free),
        torch.where(found > stride, core, 0.0),
    )


def _apart(state: State) -> Tensor:
    return state[0] < state[1]


def _refine(surface: SurfaceTensors, fixed: State, state: State, number: int) -> State:
    """Narrow the bracket: a secant, and a bisection now and then where it crawls; found makes both ends one."""
    origin, direction = fixed
    near, far, before, free = state
    share = torch.full_like(before, 0.5) if number % 4 == 3 else before / (before - free)
    middle = near + share * (far - near)
    value = free_depth(surface, origin + middle * direction)
    active = _apart(state)
    close, outside = active & (value.abs() < CLOSE_MM), active & (value > 0)
    inside = active & ~outside
    return (
        torch.where(outside | close, middle, near),
        torch.where(inside | close, middle, far),
        torch.where(outside, value, before),
        torch.where(inside, value, free),
    )


def normal(surface: SurfaceTensors, points: Points, h: Values) -> Points:
    """Unit normals into the free space, from four samples at the corners of a tetrahedron."""
    x, y, z = points
    a = free_depth(surface, torch.stack([x + h, y - h, z - h]))
    b = free_depth(surface, torch.stack([x - h, y - h, z + h]))
    c = free_depth(surface, torch.stack([x - h, y + h, z - h]))
    d = free_depth(surface, torch.stack([x + h, y + h, z + h]))
    slope = torch.stack([a - b - c + d, -a - b + c + d, -a + b - c + d])
    return slope / (slope.square().sum(0).sqrt() + 1e-12)

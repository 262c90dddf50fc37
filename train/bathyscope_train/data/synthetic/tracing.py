# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""Where a ray meets the surface of a scene, and which way the surface faces there.

Positions are double precision, maps single. All lengths are millimetres.
"""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.scene import BLOCK, TUBE, Surface

REFINEMENTS = 32
CLOSE_MM = 1e-4
FARTHEST_MM = 1000.0


@jit
def place(surface: Surface, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Row, column and reach of a point; reach is its radius in a tube and its depth over a field."""
    if surface.kind == TUBE:
        row = (z - surface.first[0]) * surface.density[0]
        last = surface.centre.shape[0] - 1
        i = min(max(int(row), 0), last - 1)
        s = min(max(row - i, 0.0), 1.0)
        dx = x - ((1 - s) * surface.centre[i, 0] + s * surface.centre[i + 1, 0])
        dy = y - ((1 - s) * surface.centre[i, 1] + s * surface.centre[i + 1, 1])
        a = dy / (abs(dx) + abs(dy) + 1e-12)
        if dx < 0:
            a = 2.0 - a
        elif dy < 0:
            a = 4.0 + a
        return row, a * surface.density[1], np.sqrt(dx * dx + dy * dy)
    return (y - surface.first[0]) * surface.density[0], (x - surface.first[1]) * surface.density[1], z


@jit
def at_rest(surface: Surface, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Where a point of swollen tissue is while it rests; the point itself where nothing swells."""
    if surface.waves.shape[0] == 0:
        return x, y, z
    along, across, dx, dy, reach = y, x, 0.0, 0.0, 1.0
    if surface.kind == TUBE:
        row = (z - surface.first[0]) * surface.density[0]
        last = surface.centre.shape[0] - 1
        i = min(max(int(row), 0), last - 1)
        s = min(max(row - i, 0.0), 1.0)
        dx = x - ((1 - s) * surface.centre[i, 0] + s * surface.centre[i + 1, 0])
        dy = y - ((1 - s) * surface.centre[i, 1] + s * surface.centre[i + 1, 1])
        along, across, reach = z, np.arctan2(dy, dx), max(np.sqrt(dx * dx + dy * dy), 1e-9)
    gain = 0.0
    for n in range(surface.waves.shape[0]):
        wave = surface.waves[n]
        gain += wave[0] * np.cos(wave[1] * along + wave[2] * across + wave[3])
    if surface.kind == TUBE:
        return x - gain * dx / reach, y - gain * dy / reach, z
    return x, y, z - gain


@jit
def free_depth(surface: Surface, x: float, y: float, z: float) -> float:
    """Positive in free space, zero on the surface; for a tube the distance to the wall within the slice."""
    row, column, reach = place(surface, x, y, z)
    return _free(surface, row, column, reach)


@jit
def _free(surface: Surface, row: float, column: float, reach: float) -> float:
    """``free_depth`` of a place."""
    rows, columns = surface.heights.shape
    if row < 0 or row > rows - 1:
        return -1.0 - reach
    i = min(int(row), rows - 2)
    s = row - i
    if surface.kind == TUBE:
        j = int(column)
        t = column - j
        j = j if j < columns else 0
        k = j + 1 if j + 1 < columns else 0
    else:
        if column < 0 or column > columns - 1:
            return -1.0
        j = min(int(column), columns - 2)
        t = column - j
        k = j + 1
    heights = surface.heights
    above = (1 - t) * heights[i, j] + t * heights[i, k]
    below = (1 - t) * heights[i + 1, j] + t * heights[i + 1, k]
    gap: float = (1 - s) * above + s * below - reach
    return gap


@jit
def trace(surface: Surface, start: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """Distance along a unit ray to the surface, looked for from ``start``."""
    near, t, leap = 0.0, start, 0.0
    before = surface.stride_mm
    free = free_depth(surface, ox + t * dx, oy + t * dy, oz + t * dz)
    while free > 0 and t < FARTHEST_MM:
        near, before = t, free
        t += max(min(0.7 * free, surface.stride_mm), 0.2 * surface.stride_mm, min(0.5 * leap, surface.leap_mm))
        row, column, reach = place(surface, ox + t * dx, oy + t * dy, oz + t * dz)
        free = _free(surface, row, column, reach)
        leap = 0.0
        if free > surface.stride_mm:
            ring = 0 if surface.kind == TUBE else int(column) // BLOCK
            leap = surface.core[int(row) // BLOCK, ring] - reach
    for step in range(REFINEMENTS):  # a secant, and a bisection now and then where it crawls
        share = 0.5 if step % 4 == 3 else before / (before - free)
        middle = near + share * (t - near)
        value = free_depth(surface, ox + middle * dx, oy + middle * dy, oz + middle * dz)
        if abs(value) < CLOSE_MM:
            return middle
        if value > 0:
            near, before = middle, value
        else:
            t, free = middle, value
    return 0.5 * (near + t)


@jit
def normal(surface: Surface, x: float, y: float, z: float, h: float) -> tuple[float, float, float]:
    """Unit normal into the free space, from four samples at the corners of a tetrahedron."""
    a = free_depth(surface, x + h, y - h, z - h)
    b = free_depth(surface, x - h, y - h, z + h)
    c = free_depth(surface, x - h, y + h, z - h)
    d = free_depth(surface, x + h, y + h, z + h)
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    scale = 1.0 / (np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12)
    return nx * scale, ny * scale, nz * scale


def clearance(surface: Surface, point: npt.NDArray[np.float64]) -> float:
    """``free_depth`` of one point: how far it is from the wall, roughly; negative outside."""
    return float(free_depth(surface, float(point[0]), float(point[1]), float(point[2])))

# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""Where a ray meets a solid, in closed form, and which way the solid faces there."""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.solids import BALL, BOX, FRUSTUM, ROOM, Solids

Array = npt.NDArray[np.float64]

NEVER = 1e9
"""The distance to a solid that a ray misses."""


@jit
def trace_solids(
    solids: Solids, start: float, end: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Distance to the first solid between ``start`` and ``end`` along a unit ray, and its number (-1: none)."""
    best, which = end, -1
    for n in range(solids.kind.shape[0]):
        kind = solids.kind[n]
        if kind != ROOM and _passes(solids.bound[n], start, best, ox, oy, oz, dx, dy, dz):
            continue
        m = solids.local_from_scene[n]
        px = m[0, 0] * ox + m[0, 1] * oy + m[0, 2] * oz + m[0, 3]
        py = m[1, 0] * ox + m[1, 1] * oy + m[1, 2] * oz + m[1, 3]
        pz = m[2, 0] * ox + m[2, 1] * oy + m[2, 2] * oz + m[2, 3]
        qx = m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz
        qy = m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz
        qz = m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz
        if kind == BALL:
            t = _ball(solids.size[n, 0], start, px, py, pz, qx, qy, qz)
        elif kind == FRUSTUM:
            t = _frustum(solids.size[n], start, px, py, pz, qx, qy, qz)
        else:
            t = _box(solids.size[n], start, kind == ROOM, px, py, pz, qx, qy, qz)
        if t < best:
            best, which = t, n
    return best, which


@jit
def _passes(
    bound: Array, start: float, end: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> bool:
    """Whether a ray misses a ball between two distances."""
    x, y, z = bound[0] - ox, bound[1] - oy, bound[2] - oz
    along = x * dx + y * dy + z * dz
    radius: float = bound[3]
    if along + radius < start or along - radius > end:
        return True
    return bool(x * x + y * y + z * z - along * along > radius * radius)


@jit
def _ball(radius: float, start: float, px: float, py: float, pz: float, qx: float, qy: float, qz: float) -> float:
    b = px * qx + py * qy + pz * qz
    gap = b * b - (px * px + py * py + pz * pz - radius * radius)
    if gap < 0:
        return NEVER
    root = np.sqrt(gap)
    if -b - root > start:
        near: float = -b - root
        return near
    return NEVER


@jit
def _box(
    half: Array, start: float, inside: bool, px: float, py: float, pz: float, qx: float, qy: float, qz: float
) -> float:
    """The way in to a box, or the way out of a room."""
    enter, leave = -NEVER, NEVER
    for axis in range(3):
        p, q = (px, qx) if axis == 0 else ((py, qy) if axis == 1 else (pz, qz))
        if abs(q) < 1e-12:
            if abs(p) > half[axis]:
                return NEVER
            continue
        first, second = (-half[axis] - p) / q, (half[axis] - p) / q
        enter = max(enter, min(first, second))
        leave = min(leave, max(first, second))
    if leave < enter:
        return NEVER
    t = leave if inside else enter
    return t if t > start else NEVER


@jit
def _frustum(size: Array, start: float, px: float, py: float, pz: float, qx: float, qy: float, qz: float) -> float:
    low, high, half = size[0], size[1], size[2]
    middle, slope = 0.5 * (low + high), 0.5 * (high - low) / half
    best = NEVER
    reach = middle + slope * pz
    a = qx * qx + qy * qy - slope * slope * qz * qz
    b = px * qx + py * qy - slope * qz * reach
    c = px * px + py * py - reach * reach
    gap = b * b - a * c
    if gap >= 0 and abs(a) > 1e-12:
        root = np.sqrt(gap)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            z = pz + t * qz
            if start < t < best and abs(z) <= half and middle + slope * z >= 0:
                best = t
    if abs(qz) > 1e-12:
        for sign in (-1.0, 1.0):
            t = (sign * half - pz) / qz
            x, y = px + t * qx, py + t * qy
            radius = high if sign > 0 else low
            if start < t < best and x * x + y * y <= radius * radius:
                best = t
    return best


@jit
def to_local(solids: Solids, n: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the scene in the frame of solid ``n``."""
    m = solids.local_from_scene[n]
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@jit
def local_normal(kind: int, size: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit normal into the free space at a point on a solid, both in the solid's frame."""
    if kind == BALL:
        return x / size[0], y / size[0], z / size[0]
    if kind == FRUSTUM:
        slope = 0.5 * (size[1] - size[0]) / size[2]
        across = np.sqrt(x * x + y * y)
        side = abs(across - 0.5 * (size[0] + size[1]) - slope * z)
        if side > size[2] - abs(z):
            return 0.0, 0.0, 1.0 if z > 0 else -1.0
        scale = 1.0 / np.sqrt(1.0 + slope * slope)
        across = max(across, 1e-12)
        return x / across * scale, y / across * scale, -slope * scale
    gx, gy, gz = size[0] - abs(x), size[1] - abs(y), size[2] - abs(z)
    outward = -1.0 if kind == ROOM else 1.0
    if gx <= gy and gx <= gz:
        return outward * np.sign(x), 0.0, 0.0
    if gy <= gz:
        return 0.0, outward * np.sign(y), 0.0
    return 0.0, 0.0, outward * np.sign(z)


@jit
def solid_clearance(solids: Solids, x: float, y: float, z: float) -> float:
    """How far a point is from the solids; negative inside one of them or outside the room.

    Beside a frustum it is the distance to its cylinder of the larger radius.
    """
    least = NEVER
    for n in range(solids.kind.shape[0]):
        px, py, pz = to_local(solids, n, x, y, z)
        size = solids.size[n]
        kind = solids.kind[n]
        if kind == BALL:
            gap = np.sqrt(px * px + py * py + pz * pz) - size[0]
        elif kind == FRUSTUM:
            side, end = np.sqrt(px * px + py * py) - max(size[0], size[1]), abs(pz) - size[2]
            gap = np.sqrt(max(side, 0.0) ** 2 + max(end, 0.0) ** 2) + min(max(side, end), 0.0)
        elif kind == BOX:
            bx, by, bz = abs(px) - size[0], abs(py) - size[1], abs(pz) - size[2]
            gap = np.sqrt(max(bx, 0.0) ** 2 + max(by, 0.0) ** 2 + max(bz, 0.0) ** 2)
            gap += min(max(bx, by, bz), 0.0)
        else:
            gap = min(size[0] - abs(px), size[1] - abs(py), size[2] - abs(pz))
        least = min(least, gap)
    return least

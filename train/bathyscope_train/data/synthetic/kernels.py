# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""The numba kernels: trace a ray to the surface, find its normal, shade it.

One thread on purpose: clips are rendered by processes, which beat numba's threads on a shared machine.
Positions are double precision, maps single. All lengths are millimetres.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba as nb
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.scene import BLOCK, TUBE, Surface, Tissue

Array = npt.NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])

_NEAREST_MM = 0.3
_REFINEMENTS = 32
_CLOSE_MM = 1e-4
_ON_SURFACE_MM = 0.05  # a ray that ends further from it has left the map
_SHEEN = 0.9  # cosine below which no highlight is left: its 100th power is 3e-5
_CREST = 0.35  # share of light that a crease keeps


class Lamp(NamedTuple):
    """The light of one clip, in the camera's frame."""

    offsets: npt.NDArray[np.float64]
    """``(lights, 3)``"""
    falloff: float
    spot: float
    ambient: float
    soft_mm: float
    """Added to the distance in squares: a light guide is no point."""


def _jit(function: F) -> F:
    return cast(F, nb.njit(cache=True, fastmath={"contract", "arcp", "nsz", "afn"}, error_model="numpy")(function))


@_jit
def _place(surface: Surface, x: float, y: float, z: float) -> tuple[float, float, float]:
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


@_jit
def free_depth(surface: Surface, x: float, y: float, z: float) -> float:
    """Positive in free space, zero on the surface; for a tube the distance to the wall within the slice."""
    row, column, reach = _place(surface, x, y, z)
    return _free(surface, row, column, reach)


@_jit
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


@_jit
def _trace(surface: Surface, start: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """Distance along a unit ray to the surface, looked for from ``start``."""
    near, t, leap = 0.0, start, 0.0
    before = surface.stride_mm
    free = free_depth(surface, ox + t * dx, oy + t * dy, oz + t * dz)
    while free > 0 and t < 1000.0:
        near, before = t, free
        t += max(min(0.7 * free, surface.stride_mm), 0.2 * surface.stride_mm, min(0.5 * leap, surface.leap_mm))
        row, column, reach = _place(surface, ox + t * dx, oy + t * dy, oz + t * dz)
        free = _free(surface, row, column, reach)
        leap = 0.0
        if free > surface.stride_mm:
            ring = 0 if surface.kind == TUBE else int(column) // BLOCK
            leap = surface.core[int(row) // BLOCK, ring] - reach
    for step in range(_REFINEMENTS):  # a secant, and a bisection now and then where it crawls
        share = 0.5 if step % 4 == 3 else before / (before - free)
        middle = near + share * (t - near)
        value = free_depth(surface, ox + middle * dx, oy + middle * dy, oz + middle * dz)
        if abs(value) < _CLOSE_MM:
            return middle
        if value > 0:
            near, before = middle, value
        else:
            t, free = middle, value
    return 0.5 * (near + t)


@_jit
def _normal(surface: Surface, x: float, y: float, z: float, h: float) -> tuple[float, float, float]:
    """Unit normal into the free space, from four samples at the corners of a tetrahedron."""
    a = free_depth(surface, x + h, y - h, z - h)
    b = free_depth(surface, x - h, y - h, z + h)
    c = free_depth(surface, x - h, y + h, z - h)
    d = free_depth(surface, x + h, y + h, z + h)
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    scale = 1.0 / (np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12)
    return nx * scale, ny * scale, nz * scale


@_jit
def _grain(solid: npt.NDArray[np.float32], u: float, v: float, w: float, out: Array) -> None:
    """Trilinear look-up of the first channels in the repeating block; coordinates in samples."""
    n = solid.shape[0]
    i, j, k = int(np.floor(u)), int(np.floor(v)), int(np.floor(w))
    a, b, c = u - i, v - j, w - k
    i, j, k = i % n, j % n, k % n
    i1, j1, k1 = (i + 1) % n, (j + 1) % n, (k + 1) % n
    for q in range(out.shape[0]):
        front = (1 - b) * ((1 - c) * solid[i, j, k, q] + c * solid[i, j, k1, q]) + b * (
            (1 - c) * solid[i, j1, k, q] + c * solid[i, j1, k1, q]
        )
        back = (1 - b) * ((1 - c) * solid[i1, j, k, q] + c * solid[i1, j, k1, q]) + b * (
            (1 - c) * solid[i1, j1, k, q] + c * solid[i1, j1, k1, q]
        )
        out[q] = (1 - a) * front + a * back


@_jit
def _vessel(tissue: Tissue, row: float, column: float, footprint: float, wrap: bool) -> float:
    """Vessel density at a place given as shares of the map, from the level that fits the footprint."""
    level = 0
    size = tissue.vessel_step_mm * 1.5
    while level < 3 and footprint > size:
        level += 1
        size *= 2
    density = tissue.vessels[level]
    rows, columns = density.shape
    u = min(max(row * rows - 0.5, 0.0), rows - 1.001)
    v = column * columns - 0.5
    i = int(u)
    j = int(np.floor(v))
    s, t = u - i, v - j
    if wrap:
        j = j % columns
        k = (j + 1) % columns
    else:
        j = min(max(j, 0), columns - 2)
        k = j + 1
    above = (1 - t) * density[i, j] + t * density[i, k]
    below = (1 - t) * density[i + 1, j] + t * density[i + 1, k]
    mixed: float = (1 - s) * above + s * below
    return mixed


@_jit
def _colour(
    surface: Surface, tissue: Tissue, x: float, y: float, z: float, footprint: float, grain: Array, out: Array
) -> None:
    """Reflectance at a point of the surface."""
    row, column, _ = _place(surface, x, y, z)
    rows, columns = surface.heights.shape
    wrap = surface.kind == TUBE
    i = min(max(int(row + 0.5), 0), rows - 1)
    j = int(column + 0.5) % columns if wrap else min(max(int(column + 0.5), 0), columns - 1)
    vessel = _vessel(tissue, (row + 0.5) / rows, (column + 0.5) / columns, footprint, wrap)
    blotch = 1.0 + tissue.mottle * grain[0]
    spot = 1.0 - tissue.spots * grain[1]
    for q in range(3):
        deep = 1.0 + 0.5 * q  # blotches are blood: blue changes most
        value = tissue.albedo[i, j, q] * (1.0 - vessel * (1.0 - tissue.vessel_tint[q]))
        out[q] = value * max(0.2, 1.0 + (blotch - 1.0) * deep) * max(0.15, 1.0 + (spot - 1.0) * deep)


@_jit
def _shade(
    surface: Surface,
    tissue: Tissue,
    lamp: Lamp,
    camera: Array,
    x: float,
    y: float,
    z: float,
    distance: float,
    footprint: float,
    grain: Array,
    coarse: Array,
    out: Array,
) -> None:
    """Radiance of a surface point into ``out[:3]``, and how much of it is highlight into ``out[3]``."""
    cell = surface.step[0]
    nx, ny, nz = _normal(surface, x, y, z, max(1.5 * cell, 0.4 * footprint))
    scale = 1.0 / tissue.solid_step_mm
    _grain(tissue.solid, 0.27 * z * scale, 0.27 * x * scale, -0.27 * y * scale, coarse)
    _grain(tissue.solid, x * scale, y * scale, z * scale, grain)
    fine = 1.0 / (1.0 + (footprint / (3.0 * tissue.solid_step_mm)) ** 2)
    grain[0] = 0.5 * grain[0] * fine + 0.8 * coarse[0]
    grain[1] = grain[1] * fine
    _colour(surface, tissue, x, y, z, footprint, grain, out)

    # The relief tilts the normal only as far as a pixel resolves it; the rest widens the highlight.
    bump = tissue.bump * fine
    mx, my, mz = nx - bump * grain[2], ny - bump * grain[3], nz - bump * grain[4]
    length = 1.0 / np.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx * length, my * length, mz * length
    lost = tissue.bump * (1.0 - fine)
    shininess = tissue.shininess / (1.0 + tissue.shininess * lost * lost)

    vx, vy, vz = (camera[0, 3] - x) / distance, (camera[1, 3] - y) / distance, (camera[2, 3] - z) / distance
    h = surface.feature_mm
    open_space = free_depth(surface, x + h * nx, y + h * ny, z + h * nz) / h
    open_space = _CREST + (1 - _CREST) * min(max(1.25 * open_space, 0.0), 1.0)

    direct, highlight = 0.0, 0.0
    lights = lamp.offsets.shape[0]
    for k in range(lights):
        sx, sy, sz = lamp.offsets[k, 0], lamp.offsets[k, 1], lamp.offsets[k, 2]
        lx = camera[0, 0] * sx + camera[0, 1] * sy + camera[0, 2] * sz + camera[0, 3] - x
        ly = camera[1, 0] * sx + camera[1, 1] * sy + camera[1, 2] * sz + camera[1, 3] - y
        lz = camera[2, 0] * sx + camera[2, 1] * sy + camera[2, 2] * sz + camera[2, 3] - z
        reach = np.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / reach, ly / reach, lz / reach
        axis = max(-(camera[0, 2] * lx + camera[1, 2] * ly + camera[2, 2] * lz), 0.0)
        power = axis**lamp.spot * (20.0 / np.sqrt(reach * reach + lamp.soft_mm**2)) ** lamp.falloff / lights
        facing = 0.7 * (mx * lx + my * ly + mz * lz) + 0.3 * (nx * lx + ny * ly + nz * lz)
        direct += power * max((facing + 0.15) / 1.15, 0.0)
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        half = (mx * hx + my * hy + mz * hz) / (np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12)
        if half > _SHEEN:
            highlight += power * half ** (10.0 * shininess) * (shininess + 2.0) / (tissue.shininess + 2.0)
    scattered = lamp.ambient * (20.0 / (distance + 5.0))
    highlight *= 7.0 * tissue.specular
    for q in range(3):
        bounced = scattered * out[q] * (1.3 if q == 0 else 1.0)
        out[q] = out[q] * open_space * (direct + bounced) + highlight
    out[3] = highlight


@_jit
def render_frame(
    surface: Surface,
    tissue: Tissue,
    lamp: Lamp,
    camera: Array,
    intrinsics: Array,
    radiance: npt.NDArray[np.float32],
    depth: npt.NDArray[np.float32],
) -> None:
    """Render one frame into ``radiance`` (h, w, 3) and ``depth`` (h, w).

    Depth is that of the ray through the pixel's centre, 0 where it left the map. Colour is that ray's too, but
    where depth
    jumps, the view grazes the surface or a highlight sits, it is the mean of four rays a pixel.
    """
    height, width = depth.shape
    grain, coarse, colour = np.empty(5), np.empty(1), np.empty(4)
    rough = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            z = _ray(surface, tissue, lamp, camera, intrinsics, _NEAREST_MM, u + 0.5, v + 0.5, grain, coarse, colour)
            depth[v, u] = z
            for q in range(3):
                radiance[v, u, q] = colour[q]
            rough[v, u] = colour[3] > 0.15
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            across = depth[v, max(u - 1, 0)] + depth[v, min(u + 1, width - 1)] - 2 * z
            along = depth[max(v - 1, 0), u] + depth[min(v + 1, height - 1), u] - 2 * z
            if rough[v, u] or abs(across) + abs(along) > 0.03 * z:
                start = max(_NEAREST_MM, 0.85 * (z - abs(across) - abs(along)))
                radiance[v, u] = 0.0
                for k in range(4):
                    du, dv = 0.25 + 0.5 * (k % 2), 0.25 + 0.5 * (k // 2)
                    _ray(surface, tissue, lamp, camera, intrinsics, start, u + du, v + dv, grain, coarse, colour)
                    for q in range(3):
                        radiance[v, u, q] += 0.25 * colour[q]


@_jit
def _ray(
    surface: Surface,
    tissue: Tissue,
    lamp: Lamp,
    camera: Array,
    intrinsics: Array,
    start: float,
    u: float,
    v: float,
    grain: Array,
    coarse: Array,
    colour: Array,
) -> float:
    """Trace and shade the ray through image point (u, v); returns its z-depth, 0 if it left the map."""
    a = (u - intrinsics[0, 2]) / intrinsics[0, 0]
    b = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    slant = np.sqrt(a * a + b * b + 1.0)
    dx = (camera[0, 0] * a + camera[0, 1] * b + camera[0, 2]) / slant
    dy = (camera[1, 0] * a + camera[1, 1] * b + camera[1, 2]) / slant
    dz = (camera[2, 0] * a + camera[2, 1] * b + camera[2, 2]) / slant
    ox, oy, oz = camera[0, 3], camera[1, 3], camera[2, 3]
    t = _trace(surface, start, ox, oy, oz, dx, dy, dz)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    footprint = t / intrinsics[0, 0]
    _shade(surface, tissue, lamp, camera, x, y, z, t, footprint, grain, coarse, colour)
    return t / slant if abs(free_depth(surface, x, y, z)) < _ON_SURFACE_MM else 0.0


def clearance(surface: Surface, point: npt.NDArray[np.float64]) -> float:
    """``free_depth`` of one point: how far it is from the wall, roughly; negative outside."""
    return float(free_depth(surface, float(point[0]), float(point[1]), float(point[2])))


def render(
    surface: Surface,
    tissue: Tissue,
    lamp: Lamp,
    scene_from_camera: npt.NDArray[np.float64],
    intrinsics: npt.NDArray[np.float64],
    size: tuple[int, int],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Linear radiance ``(h, w, 3)`` and z-depth ``(h, w)`` of one frame.

    Args:
        surface: Geometry.
        tissue: Material.
        lamp: Light, carried by the camera.
        scene_from_camera: Pose, 4x4, OpenCV axes.
        intrinsics: 3x3, in pixels of ``size``.
        size: Height and width.
    """
    radiance, depth = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
    render_frame(surface, tissue, lamp, np.ascontiguousarray(scene_from_camera), intrinsics, radiance, depth)
    return radiance, depth

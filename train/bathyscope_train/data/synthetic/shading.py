# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""How bright a point of the surface is: its colour, its fine relief, the lamp's light and the highlights."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.scene import TUBE, Surface, Tissue
from bathyscope_train.data.synthetic.tracing import free_depth, normal, place

Array = npt.NDArray[np.float64]

SHEEN = 0.9  # cosine below which no highlight is left: its 100th power is 3e-5
CREST = 0.35  # share of light that a crease keeps


class Lamp(NamedTuple):
    """The light of one clip, in the camera's frame."""

    offsets: npt.NDArray[np.float64]
    """``(lights, 3)``"""
    falloff: float
    spot: float
    ambient: float
    soft_mm: float
    """Added to the distance in squares: a light guide is no point."""


@jit
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


@jit
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


@jit
def _colour(
    surface: Surface, tissue: Tissue, x: float, y: float, z: float, footprint: float, grain: Array, out: Array
) -> None:
    """Reflectance at a point of the surface."""
    row, column, _ = place(surface, x, y, z)
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


@jit
def shade(
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
    nx, ny, nz = normal(surface, x, y, z, max(1.5 * cell, 0.4 * footprint))
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
    open_space = CREST + (1 - CREST) * min(max(1.25 * open_space, 0.0), 1.0)

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
        if half > SHEEN:
            highlight += power * half ** (10.0 * shininess) * (shininess + 2.0) / (tissue.shininess + 2.0)
    scattered = lamp.ambient * (20.0 / (distance + 5.0))
    highlight *= 7.0 * tissue.specular
    for q in range(3):
        bounced = scattered * out[q] * (1.3 if q == 0 else 1.0)
        out[q] = out[q] * open_space * (direct + bounced) + highlight
    out[3] = highlight

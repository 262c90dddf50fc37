# ruff: noqa: PLR0917, PLR0911 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""How bright a point of a solid is: its pattern, the endoscope's lamp, the lamps of a room, highlights."""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.shading import Lamp, beam_axis, soft_edge
from bathyscope_train.data.synthetic.solid_tracing import local_normal, to_local, trace_solids
from bathyscope_train.data.synthetic.solids import (
    BALL,
    CLOUDS,
    COLLAGE,
    FRUSTUM,
    PLAIN,
    PRINT,
    STRIPES,
    TILES,
    WOOD,
    Solids,
)

Array = npt.NDArray[np.float64]

_OFF_SURFACE_MM = 1e-3


@jit
def scatter(i: int, j: int, k: int) -> float:
    """A number in [0, 1) that looks random and depends on three integers alone."""
    n = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    n = (n ^ (n >> 13)) & 0x7FFFFFFF
    n = (n * 1274126177) & 0x7FFFFFFF
    n = n ^ (n >> 16)
    return (n & 0xFFFF) / 65536.0


@jit
def value_noise(u: float, v: float, seed: int) -> float:
    """Smooth noise in [0, 1] with a grain of 1."""
    i, j = int(np.floor(u)), int(np.floor(v))
    s, t = u - i, v - j
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    above = (1 - t) * scatter(i, j, seed) + t * scatter(i, j + 1, seed)
    below = (1 - t) * scatter(i + 1, j, seed) + t * scatter(i + 1, j + 1, seed)
    mixed: float = (1 - s) * above + s * below
    return mixed


@jit
def pattern(kind: int, u: float, v: float, seed: int) -> float:
    """Share of the second colour at a place of a face, in grains: clouds, boards, tiles, stripes, text, pictures."""
    if kind == CLOUDS:
        return 0.6 * value_noise(u, v, seed) + 0.4 * value_noise(2.7 * u, 2.7 * v, seed + 1)
    if kind == WOOD:
        board = int(np.floor(0.5 * v))
        rings = value_noise(0.12 * u + 7.0 * board, 2.5 * v, seed) * 5.0
        seam = 1.0 if 0.5 * v - board < 0.03 else 0.0
        tone: float = 0.7 * (rings - np.floor(rings)) + 0.3 * scatter(board, seed, 3)
        return max(seam, tone)
    if kind == TILES:
        i, j = int(np.floor(u)), int(np.floor(v))
        joint = u - i < 0.06 or v - j < 0.06
        return 1.0 if joint else 0.25 * scatter(i, j, seed)
    if kind == STRIPES:
        return 1.0 if u - np.floor(u) < 0.5 else 0.0
    if kind == PRINT:  # lines of words, a title, a margin
        line = int(np.floor(v))
        word = int(np.floor(0.7 * u + 5.0 * scatter(line, seed, 1)))
        written = v - line < 0.5 and scatter(word, line, seed) < 0.75 and scatter(line, seed, 2) < 0.8
        letter = 0.5 + 0.5 * scatter(int(np.floor(5.0 * u)), line, seed)
        return letter if written else 0.0
    if kind == COLLAGE:  # rectangles of two sizes
        i = int(np.floor(u))
        j = int(np.floor(v + 7.0 * scatter(i, seed, 5)))
        inner = scatter(int(np.floor(3.0 * u)), int(np.floor(4.0 * v)), seed)
        return 0.75 * scatter(i, j, seed) + 0.25 * inner
    return 0.0


@jit
def solid_colour(
    solids: Solids, n: int, x: float, y: float, z: float, nx: float, ny: float, nz: float, footprint: float, out: Array
) -> None:
    """Reflectance at a point of a solid, point and normal in its own frame."""
    look = solids.look[n]
    grain = look[7]
    kind = solids.kind[n]
    face = 0
    if kind == FRUSTUM and abs(nz) < 0.9:
        u, v = z, np.arctan2(y, x) * 0.5 * (solids.size[n, 0] + solids.size[n, 1])
    elif kind == BALL or abs(nz) > 0.5:
        u, v, face = x, y, 1 if nz > 0 else 2
    elif abs(nx) > 0.5:
        u, v, face = z, y, 3 if nx > 0 else 4
    else:
        u, v, face = x, z, 5 if ny > 0 else 6
    share = 0.0
    if int(look[6]) != PLAIN:
        share = pattern(int(look[6]), u / grain + 100.0, v / grain + 100.0, 31 * n + face)
        sharp = 1.0 / (1.0 + (2.0 * footprint / grain) ** 2)
        share = 0.35 + (share - 0.35) * sharp
    share *= look[8]
    for q in range(3):
        out[q] = look[q] * (1.0 - share) + look[3 + q] * share


@jit
def _add(
    solids: Solids,
    n: int,
    power: float,
    lx: float,
    ly: float,
    lz: float,
    nx: float,
    ny: float,
    nz: float,
    vx: float,
    vy: float,
    vz: float,
) -> tuple[float, float]:
    """Scattered and mirrored light of one lamp."""
    facing = nx * lx + ny * ly + nz * lz
    if facing <= 0:
        return 0.0, 0.0
    metal = solids.look[n, 11]
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    half = (nx * hx + ny * hy + nz * hz) / (np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12)
    shininess = solids.look[n, 10]
    gloss = power * max(half, 0.0) ** (4.0 * shininess) * (shininess + 2.0) / 10.0 * solids.look[n, 9]
    return power * ((1.0 - metal) * facing + 0.8 * metal * facing**4), gloss


@jit
def shade_solid(
    solids: Solids,
    n: int,
    lamp: Lamp,
    camera: Array,
    x: float,
    y: float,
    z: float,
    distance: float,
    footprint: float,
    out: Array,
) -> None:
    """Radiance of a point of solid ``n`` into ``out[:3]``, and how much of it is highlight into ``out[3]``."""
    px, py, pz = to_local(solids, n, x, y, z)
    ax, ay, az = local_normal(solids.kind[n], solids.size[n], px, py, pz)
    solid_colour(solids, n, px, py, pz, ax, ay, az, footprint, out)
    m = solids.local_from_scene[n]
    nx = m[0, 0] * ax + m[1, 0] * ay + m[2, 0] * az
    ny = m[0, 1] * ax + m[1, 1] * ay + m[2, 1] * az
    nz = m[0, 2] * ax + m[1, 2] * ay + m[2, 2] * az
    vx, vy, vz = (camera[0, 3] - x) / distance, (camera[1, 3] - y) / distance, (camera[2, 3] - z) / distance
    direct, highlight = 0.0, 0.0
    lights = lamp.offsets.shape[0]
    bx, by, bz = beam_axis(lamp, camera)
    if solids.lamp_share > 0:
        for k in range(lights):
            sx, sy, sz = lamp.offsets[k, 0], lamp.offsets[k, 1], lamp.offsets[k, 2]
            lx = camera[0, 0] * sx + camera[0, 1] * sy + camera[0, 2] * sz + camera[0, 3] - x
            ly = camera[1, 0] * sx + camera[1, 1] * sy + camera[1, 2] * sz + camera[1, 3] - y
            lz = camera[2, 0] * sx + camera[2, 1] * sy + camera[2, 2] * sz + camera[2, 3] - z
            reach = np.sqrt(lx * lx + ly * ly + lz * lz)
            lx, ly, lz = lx / reach, ly / reach, lz / reach
            axis = max(-(bx * lx + by * ly + bz * lz), 0.0)
            power = axis**lamp.spot * (20.0 / np.sqrt(reach * reach + lamp.soft_mm**2)) ** lamp.falloff / lights
            if lamp.cone[1] >= -1.0:
                power *= soft_edge(axis, lamp.cone)
            more, gloss = _add(solids, n, solids.lamp_share * power, lx, ly, lz, nx, ny, nz, vx, vy, vz)
            direct += more
            highlight += gloss
    for k in range(solids.lights.shape[0]):
        lx, ly, lz = solids.lights[k, 0] - x, solids.lights[k, 1] - y, solids.lights[k, 2] - z
        reach = np.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / reach, ly / reach, lz / reach
        if nx * lx + ny * ly + nz * lz > 0:
            blocked, _ = trace_solids(solids, _OFF_SURFACE_MM * reach, reach, x, y, z, lx, ly, lz)
            power = solids.lights[k, 3] * 4.0 / (1.0 + 3.0 * (reach / solids.reach_mm) ** 2)
            power *= 1.0 if blocked >= reach else 0.12
            more, gloss = _add(solids, n, power, lx, ly, lz, nx, ny, nz, vx, vy, vz)
            direct += more
            highlight += gloss
    direct += solids.sky * (0.75 - 0.25 * ny)
    for q in range(3):
        out[q] = out[q] * direct + highlight
    out[3] = highlight

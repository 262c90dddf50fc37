# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""How bright a point of the surface is: its colour, its fine relief, the lamp's light and the highlights."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.scene import TUBE, Surface, Tissue
from bathyscope_train.data.synthetic.tracing import at_rest, free_depth, normal, place

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
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector along the beam."""
    cone: tuple[float, float] = (-1.0, -2.0)
    """Cosines from the beam's axis at which its soft edge begins and ends; an end below -1 is no edge."""


FINER = 3.1
"""Density of the third octave of tissue against the second."""
LARGER = 0.085
"""Density of the large regions against the second octave."""
BROADER = 0.45
"""Density of the relief of the wet film against that of the tissue."""
CAPILLARY = 0.16
"""Half width of a capillary, in standard deviations of the blotches."""
_LEAST = 0.05  # visibility below which the third octave is left out
STRAY = 0.03
"""Share of the light beyond the edge of the beam."""


@jit
def soft_edge(cosine: float, cone: tuple[float, float]) -> float:
    """Share of a beam's light at an angle from its axis: 1 inside, falling smoothly to the stray light."""
    s = min(max((cosine - cone[1]) / (cone[0] - cone[1]), 0.0), 1.0)
    return STRAY + (1.0 - STRAY) * s * s * (3.0 - 2.0 * s)


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
    surface: Surface,
    tissue: Tissue,
    x: float,
    y: float,
    z: float,
    footprint: float,
    grain: Array,
    capillary: float,
    region: float,
    out: Array,
) -> float:
    """Reflectance at a point of the surface; returns its gloss against the rest of the tissue."""
    row, column, _ = place(surface, x, y, z)
    rows, columns = surface.heights.shape
    wrap = surface.kind == TUBE
    i = min(max(int(row + 0.5), 0), rows - 1)
    j = int(column + 0.5) % columns if wrap else min(max(int(column + 0.5), 0), columns - 1)
    vessel = _vessel(tissue, (row + 0.5) / rows, (column + 0.5) / columns, footprint, wrap)
    vessel += capillary * (1.0 - vessel)
    blotch = 1.0 + tissue.mottle * grain[0]
    spot = 1.0 - tissue.spots * grain[1]
    for q in range(3):
        deep = 1.0 + 0.5 * q  # blotches are blood: blue changes most
        value = region * tissue.albedo[i, j, q] * (1.0 - vessel * (1.0 - tissue.vessel_tint[q]))
        out[q] = value * max(0.2, 1.0 + (blotch - 1.0) * deep) * max(0.15, 1.0 + (spot - 1.0) * deep)
    gloss: float = tissue.gloss[i, j] if tissue.gloss.shape[0] == rows else 1.0
    return gloss


@jit
def _mucosa(tissue: Tissue, x: float, y: float, z: float, footprint: float, coarse: float, grain: Array) -> float:
    """Add a third, finer octave of blotches and relief to ``grain``; returns the density of capillaries.

    The same block, read ``FINER`` times as densely. Capillaries are where its blotches change sign.
    """
    scale = FINER / tissue.solid_step_mm
    visible = 1.0 / (1.0 + (footprint * scale / 3.0) ** 2)
    if visible < _LEAST:
        return 0.0
    blotch, spot, gx, gy, gz = grain[0], grain[1], grain[2], grain[3], grain[4]
    _grain(tissue.solid, scale * y, scale * z, scale * x, grain)
    line = grain[0] / CAPILLARY
    share = tissue.fine * visible
    grain[0] = blotch + 0.5 * share * grain[0]
    grain[1] = spot
    grain[2], grain[3], grain[4] = gx + share * grain[2], gy + share * grain[3], gz + share * grain[4]
    density: float = tissue.capillaries * visible * np.exp(-line * line) * min(max(0.5 + coarse, 0.0), 1.0)
    return density


@jit
def _region(tissue: Tissue, x: float, y: float, z: float, coarse: Array) -> float:
    """Share of the colour that a light or dark region leaves: 1 in the light ones, ``e^-regions`` in the dark."""
    if tissue.regions == 0.0:
        return 1.0
    scale = LARGER / tissue.solid_step_mm
    _grain(tissue.solid, scale * x, -scale * z, scale * y, coarse)
    side = min(max(tissue.region_edge * (coarse[0] - tissue.region_level), -1.0), 1.0)
    share: float = np.exp(0.5 * tissue.regions * (side - 1.0))
    return share


@jit
def _octaves(
    tissue: Tissue, x: float, y: float, z: float, footprint: float, grain: Array, coarse: Array
) -> tuple[float, float]:
    """Blotches, spots and relief into ``grain``; returns how far their own octave is resolved, and capillaries."""
    scale = 1.0 / tissue.solid_step_mm
    _grain(tissue.solid, 0.27 * z * scale, 0.27 * x * scale, -0.27 * y * scale, coarse)
    _grain(tissue.solid, x * scale, y * scale, z * scale, grain)
    fine = 1.0 / (1.0 + (footprint / (3.0 * tissue.solid_step_mm)) ** 2)
    grain[0] = 0.5 * grain[0] * fine + 0.8 * coarse[0]
    grain[1] = grain[1] * fine
    capillary = 0.0
    if tissue.fine > 0.0 or tissue.capillaries > 0.0:
        capillary = _mucosa(tissue, x, y, z, footprint, coarse[0], grain)
    return fine, capillary


@jit
def _film(tissue: Tissue, x: float, y: float, z: float, grain: Array) -> float:
    """How wet a point is, in [0, 1]; the slope of its film into ``grain[2:5]``."""
    scale = BROADER / tissue.solid_step_mm
    _grain(tissue.solid, scale * y, scale * z, scale * x, grain)
    wet: float = min(max(2.0 * (grain[0] - tissue.dry) + 0.5, 0.0), 1.0)
    return wet


@jit
def _tilt(nx: float, ny: float, nz: float, gx: float, gy: float, gz: float, slope: float) -> tuple[float, float, float]:
    """A unit normal tilted by a relief."""
    mx, my, mz = nx - slope * gx, ny - slope * gy, nz - slope * gz
    length = 1.0 / np.sqrt(mx * mx + my * my + mz * mz)
    return mx * length, my * length, mz * length


@jit
def beam_axis(lamp: Lamp, camera: Array) -> tuple[float, float, float]:
    """The beam's axis in the scene's frame."""
    ax, ay, az = lamp.axis
    return (
        camera[0, 0] * ax + camera[0, 1] * ay + camera[0, 2] * az,
        camera[1, 0] * ax + camera[1, 1] * ay + camera[1, 2] * az,
        camera[2, 0] * ax + camera[2, 1] * ay + camera[2, 2] * az,
    )


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
    tx, ty, tz = at_rest(surface, x, y, z)  # its texture goes with the tissue
    fine, capillary = _octaves(tissue, tx, ty, tz, footprint, grain, coarse)
    region = _region(tissue, tx, ty, tz, coarse)
    gloss = _colour(surface, tissue, x, y, z, footprint, grain, capillary, region, out)

    # The relief tilts the normal only as far as a pixel resolves it; the rest widens the highlight.
    bump = tissue.bump * fine
    mx, my, mz = _tilt(nx, ny, nz, grain[2], grain[3], grain[4], bump)
    lost = tissue.bump * (1.0 - fine)
    shininess = tissue.shininess / (1.0 + tissue.shininess * lost * lost)

    # A wet film lies over the relief: smoother, broken where the tissue is dry, with small sharp highlights.
    coat, wx, wy, wz = 0.0, nx, ny, nz
    if tissue.coat > 0.0:
        gx, gy, gz = 0.35 * fine * grain[2], 0.35 * fine * grain[3], 0.35 * fine * grain[4]
        coat = 7.0 * tissue.coat * _film(tissue, tx, ty, tz, grain)
        wx, wy, wz = _tilt(nx, ny, nz, gx + grain[2], gy + grain[3], gz + grain[4], tissue.coat_bump)

    vx, vy, vz = (camera[0, 3] - x) / distance, (camera[1, 3] - y) / distance, (camera[2, 3] - z) / distance
    h = surface.feature_mm
    open_space = free_depth(surface, x + h * nx, y + h * ny, z + h * nz) / h
    open_space = CREST + (1 - CREST) * min(max(1.25 * open_space, 0.0), 1.0)

    bx, by, bz = beam_axis(lamp, camera)
    direct, highlight, sheen = 0.0, 0.0, 0.0
    lights = lamp.offsets.shape[0]
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
        facing = 0.7 * (mx * lx + my * ly + mz * lz) + 0.3 * (nx * lx + ny * ly + nz * lz)
        direct += power * max((facing + 0.15) / 1.15, 0.0)
        hx, hy, hz = lx + vx, ly + vy, lz + vz
        middle = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
        half = (mx * hx + my * hy + mz * hz) / middle
        if half > SHEEN:
            highlight += power * half ** (10.0 * shininess) * (shininess + 2.0) / (tissue.shininess + 2.0)
        if coat > 0.0:
            half = (wx * hx + wy * hy + wz * hz) / middle
            if half > SHEEN:
                sheen += power * half ** (10.0 * tissue.coat_shininess)
    scattered = lamp.ambient * (20.0 / (distance + 5.0))
    highlight *= 7.0 * tissue.specular
    highlight = gloss * (highlight + coat * sheen)
    for q in range(3):
        bounced = scattered * out[q] * (1.3 if q == 0 else 1.0)
        out[q] = out[q] * open_space * (direct + bounced) + highlight
    out[3] = highlight

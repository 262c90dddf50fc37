# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""Render one frame: a ray a pixel, traced and shaded, and four where one would alias."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.lens import PINHOLE, Distortion, unbend
from bathyscope_train.data.synthetic.scene import NOTHING, Surface, Tissue
from bathyscope_train.data.synthetic.shading import Lamp, shade
from bathyscope_train.data.synthetic.solid_shading import shade_solid
from bathyscope_train.data.synthetic.solid_tracing import NEVER, trace_solids
from bathyscope_train.data.synthetic.solids import NO_SOLIDS, Solids
from bathyscope_train.data.synthetic.tracing import free_depth, trace

Array = npt.NDArray[np.float64]

NEAREST_MM = 0.3
ON_SURFACE_MM = 0.05  # a ray that ends further from it has left the map


class Picture(NamedTuple):
    """One rendered frame."""

    radiance: npt.NDArray[np.float32]
    """``(h, w, 3)``, linear."""
    depth: npt.NDArray[np.float32]
    """``(h, w)``: z-depth of the ray through each pixel's centre; 0 where there is nothing."""
    mover: npt.NDArray[np.uint8]
    """``(h, w)``: 0 on what stands still, k on mover k."""


class Aim(NamedTuple):
    """Where the rays of a frame start and which way they go."""

    camera: Array
    """``scene_from_camera``, 4x4."""
    intrinsics: Array
    k1: float
    k2: float


@jit
def render_frame(
    surface: Surface,
    tissue: Tissue,
    solids: Solids,
    lamp: Lamp,
    aim: Aim,
    radiance: npt.NDArray[np.float32],
    depth: npt.NDArray[np.float32],
    mover: npt.NDArray[np.uint8],
) -> None:
    """Render one frame into ``radiance`` (h, w, 3), ``depth`` (h, w) and ``mover`` (h, w).

    Depth is that of the ray through the pixel's centre, 0 where it left the map. Colour is that ray's too, but
    where depth jumps, the view grazes the surface or a highlight sits, it is the mean of four rays a pixel.
    """
    height, width = depth.shape
    grain, coarse, colour = np.empty(5), np.empty(1), np.empty(4)
    rough = np.zeros((height, width), np.bool_)
    hit = np.full((height, width), -1, np.int32)
    plain = np.zeros((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            z, which = _ray(surface, tissue, solids, lamp, aim, NEAREST_MM, u + 0.5, v + 0.5, grain, coarse, colour)
            depth[v, u] = z
            hit[v, u] = which
            mover[v, u] = solids.mover[which] if which >= 0 else 0
            for q in range(3):
                radiance[v, u, q] = colour[q]
            plain[v, u] = colour[0] + colour[1] + colour[2]
            rough[v, u] = colour[3] > 0.15
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            left, right, up, down = max(u - 1, 0), min(u + 1, width - 1), max(v - 1, 0), min(v + 1, height - 1)
            across = depth[v, left] + depth[v, right] - 2 * z
            along = depth[up, u] + depth[down, u] - 2 * z
            other = hit[v, left] != hit[v, u] or hit[v, right] != hit[v, u]
            other = other or hit[up, u] != hit[v, u] or hit[down, u] != hit[v, u]
            if hit[v, u] >= 0 and not other:  # edges of a pattern or a shadow
                here = plain[v, u]
                jump = abs(plain[v, left] - here) + abs(plain[v, right] - here)
                jump += abs(plain[up, u] - here) + abs(plain[down, u] - here)
                other = jump > 0.25 * here
            if rough[v, u] or other or abs(across) + abs(along) > 0.03 * z:
                start = max(NEAREST_MM, 0.85 * (z - abs(across) - abs(along)))
                radiance[v, u] = 0.0
                for k in range(4):
                    du, dv = 0.25 + 0.5 * (k % 2), 0.25 + 0.5 * (k // 2)
                    _ray(surface, tissue, solids, lamp, aim, start, u + du, v + dv, grain, coarse, colour)
                    for q in range(3):
                        radiance[v, u, q] += 0.25 * colour[q]


@jit
def _ray(
    surface: Surface,
    tissue: Tissue,
    solids: Solids,
    lamp: Lamp,
    aim: Aim,
    start: float,
    u: float,
    v: float,
    grain: Array,
    coarse: Array,
    colour: Array,
) -> tuple[float, int]:
    """Trace and shade the ray through image point (u, v); returns its z-depth, 0 if it left the map, and its solid."""
    camera, intrinsics = aim.camera, aim.intrinsics
    a = (u - intrinsics[0, 2]) / intrinsics[0, 0]
    b = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    a, b = unbend(a, b, aim.k1, aim.k2)
    slant = np.sqrt(a * a + b * b + 1.0)
    dx = (camera[0, 0] * a + camera[0, 1] * b + camera[0, 2]) / slant
    dy = (camera[1, 0] * a + camera[1, 1] * b + camera[1, 2]) / slant
    dz = (camera[2, 0] * a + camera[2, 1] * b + camera[2, 2]) / slant
    ox, oy, oz = camera[0, 3], camera[1, 3], camera[2, 3]
    nearest, which = trace_solids(solids, NEAREST_MM, NEVER, ox, oy, oz, dx, dy, dz)
    t = trace(surface, start, ox, oy, oz, dx, dy, dz) if surface.kind != NOTHING else NEVER
    if which >= 0 and nearest < t:
        x, y, z = ox + nearest * dx, oy + nearest * dy, oz + nearest * dz
        shade_solid(solids, which, lamp, camera, x, y, z, nearest, nearest / intrinsics[0, 0], colour)
        return nearest / slant, which
    if surface.kind == NOTHING:
        colour[:] = 0.0
        return 0.0, -1
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    footprint = t / intrinsics[0, 0]
    shade(surface, tissue, lamp, camera, x, y, z, t, footprint, grain, coarse, colour)
    return t / slant if abs(free_depth(surface, x, y, z)) < ON_SURFACE_MM else 0.0, -1


def render(
    surface: Surface,
    tissue: Tissue,
    lamp: Lamp,
    scene_from_camera: npt.NDArray[np.float64],
    intrinsics: npt.NDArray[np.float64],
    size: tuple[int, int],
    *,
    solids: Solids = NO_SOLIDS,
    distortion: Distortion = PINHOLE,
) -> Picture:
    """One frame.

    Args:
        surface: Geometry.
        tissue: Material.
        lamp: Light, carried by the camera.
        scene_from_camera: Pose, 4x4, OpenCV axes.
        intrinsics: 3x3, in pixels of ``size``.
        size: Height and width.
        solids: Hard bodies, where they are in this frame.
        distortion: Of the lens.
    """
    picture = Picture(np.empty((*size, 3), np.float32), np.empty(size, np.float32), np.zeros(size, np.uint8))
    aim = Aim(np.ascontiguousarray(scene_from_camera), intrinsics, float(distortion.k1), float(distortion.k2))
    render_frame(surface, tissue, solids, lamp, aim, picture.radiance, picture.depth, picture.mover)
    return picture

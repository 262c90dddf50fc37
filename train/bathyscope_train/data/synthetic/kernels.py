# ruff: noqa: PLR0917 - the inner functions of a kernel take plain numbers, in the order of the algebra
"""Render one frame: a ray a pixel, traced and shaded, and four where one would alias."""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.compiled import jit
from bathyscope_train.data.synthetic.scene import Surface, Tissue
from bathyscope_train.data.synthetic.shading import Lamp, shade
from bathyscope_train.data.synthetic.tracing import free_depth, trace

Array = npt.NDArray[np.float64]

NEAREST_MM = 0.3
ON_SURFACE_MM = 0.05  # a ray that ends further from it has left the map


@jit
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
            z = _ray(surface, tissue, lamp, camera, intrinsics, NEAREST_MM, u + 0.5, v + 0.5, grain, coarse, colour)
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
                start = max(NEAREST_MM, 0.85 * (z - abs(across) - abs(along)))
                radiance[v, u] = 0.0
                for k in range(4):
                    du, dv = 0.25 + 0.5 * (k % 2), 0.25 + 0.5 * (k // 2)
                    _ray(surface, tissue, lamp, camera, intrinsics, start, u + du, v + dv, grain, coarse, colour)
                    for q in range(3):
                        radiance[v, u, q] += 0.25 * colour[q]


@jit
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
    t = trace(surface, start, ox, oy, oz, dx, dy, dz)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    footprint = t / intrinsics[0, 0]
    shade(surface, tissue, lamp, camera, x, y, z, t, footprint, grain, coarse, colour)
    return t / slant if abs(free_depth(surface, x, y, z)) < ON_SURFACE_MM else 0.0


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

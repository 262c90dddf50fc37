"""The numba backend: a scene packed for the kernels, and one view of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope.splat.kernel_blend import COLOURED, PIXELS, PLAIN, Scratch, blend
from bathyscope.splat.kernel_order import TILE, nearest_first
from bathyscope.splat.kernel_pack import initial_tiles, pack, project_all, unpack
from bathyscope.splat.kernel_project import (
    BLUE,
    COMPENSATION,
    DEPTH,
    GREEN,
    L0,
    L1,
    L2,
    PROJECTED,
    RADIUS_U,
    RADIUS_V,
    RECORD,
    RED,
    TWO_LN2,
    U,
    V,
    camera_numbers,
)
from bathyscope.splat.rendering import Floats, Projection, Rendering
from bathyscope.splat.settings import SplatSettings
from bathyscope.splat.view import View

F32 = NDArray[np.float32]
NOT_FINITE = "harmonics of visible Gaussians have values that are not finite; render without colour"


@dataclass(frozen=True, slots=True)
class CompiledScene:
    """A scene as the kernels read it; nothing in it is ever written again."""

    count: int
    columns: F32
    """(5, n rounded up to eight) what is asked of every Gaussian: mean, largest scale, log2 of the opacity."""
    records: F32
    """(n, RECORD) what is asked of those that may touch the image."""
    harmonics: F32

    @classmethod
    def of(cls, scene: Gaussians) -> CompiledScene:
        """Pack ``scene``; its harmonics are kept as they are if they are contiguous float32."""
        arrays = (scene.means, scene.rotations, scene.scales, scene.opacities, scene.harmonics)
        means, rotations, scales, opacities, harmonics = (np.ascontiguousarray(a, np.float32) for a in arrays)
        count = len(scene)
        columns = np.empty((5, -(-count // 8) * 8), np.float32)
        records = np.empty((count, RECORD), np.float32)
        pack(means, rotations, scales, opacities, columns, records)
        return cls(count, columns, records, harmonics)

    def render(self, view: View, settings: SplatSettings, degree: int | None, background: Floats | None) -> Rendering:
        """One view; colour only if there is a ``degree``."""
        height, width = view.size
        camera = camera_numbers(view, settings)
        order, count, boxes = nearest_first(self.columns, camera)
        rows, columns = -(-height // TILE), -(-width // TILE)
        state = np.zeros((rows * columns, PLAIN if degree is None else COLOURED, PIXELS), np.float32)
        alive = np.empty(rows * columns, np.uint64)
        initial_tiles(width, height, columns, alive, state)
        blend(
            order,
            count,
            boxes,
            self.records,
            self.harmonics,
            degree or 0,
            camera,
            settings.antialiased,
            alive,
            columns,
            state,
            Scratch.of(rows * columns),
        )
        return self._finish(state, view, columns, degree is not None, background)

    def project(self, view: View, settings: SplatSettings, degree: int | None) -> Projection:
        """All Gaussians seen by ``view``; colours only if there is a ``degree``."""
        out = np.empty((PROJECTED, self.count), np.float32)
        wanted = -1 if degree is None else degree
        camera = camera_numbers(view, settings)
        project_all(self.records, self.harmonics, wanted, camera, settings.antialiased, Scratch.of(0), out)
        return _projection(out, degree is not None)

    @staticmethod
    def _finish(state: F32, view: View, columns: int, coloured: bool, background: Floats | None) -> Rendering:
        height, width = view.size
        planes = np.empty((3, height, width), np.float32)
        image = np.empty((height, width, 3) if coloured else (0, 0, 3), np.float32)
        behind = np.zeros(3, np.float32) if background is None else background.astype(np.float32)
        finite = unpack(state, columns, behind, planes, image)
        if not finite:
            raise GeometryError(NOT_FINITE)
        return Rendering(image if coloured else None, planes[0], planes[1], planes[2])


def _projection(out: F32, coloured: bool) -> Projection:
    """Name the rows of ``out`` (PROJECTED, n), with the conics multiplied out again."""
    radii = out[[RADIUS_U, RADIUS_V]].T.astype(np.int32)
    visible = np.asarray((radii > 0).any(-1))
    out[:, ~visible] = np.nan
    l0, l1, l2 = out[[L0, L1, L2]]
    conics = TWO_LN2 * np.stack([l0 * l0, l0 * l1, l1 * l1 + l2 * l2], -1)
    colours = None
    if coloured:
        colours = np.ascontiguousarray(out[[RED, GREEN, BLUE]].T)
        if not np.isfinite(colours[visible]).all():
            raise GeometryError(NOT_FINITE)
    means = np.ascontiguousarray(out[[U, V]].T)
    return Projection(means, conics, out[DEPTH].copy(), out[COMPENSATION].copy(), radii, visible, colours)

"""Kernels: between the arrays of callers and those of the blending kernel."""

from __future__ import annotations

from math import log2, sqrt
from typing import Any

import numpy as np

from bathyscope.splat import lanes
from bathyscope.splat.jit import kernel
from bathyscope.splat.kernel_blend import ACCUMULATED, COLOUR, COLOURED, LIGHT, OPACITY, PIXELS
from bathyscope.splat.kernel_harmonics import colour
from bathyscope.splat.kernel_order import TILE
from bathyscope.splat.kernel_project import (
    AXES,
    CHUNK,
    LOG_OPACITY,
    MEAN,
    PROJECTED,
    RECORD,
    project_eight,
)

_NOTHING = np.float32(-np.inf)
_FLOOR = np.float32(1e-10)
_ONE, _TWO, _ZERO = np.float32(1), np.float32(2), np.float32(0)


@kernel
def pack(means: Any, rotations: Any, scales: Any, opacities: Any, columns: Any, records: Any) -> None:
    """Fill ``columns`` (5, n rounded up) and ``records`` (n, RECORD) of a ``CompiledScene``."""
    count = len(means)
    for i in range(count, columns.shape[1]):
        columns[0, i] = columns[1, i] = columns[2, i] = columns[3, i] = _ZERO
        columns[4, i] = _NOTHING
    for i in range(count):
        w, x, y, z = rotations[i, 0], rotations[i, 1], rotations[i, 2], rotations[i, 3]
        # Double precision, as a quaternion need not be near unit length.
        shrink = 1.0 / sqrt(float(w) * w + float(x) * x + float(y) * y + float(z) * z)
        w, x, y, z = np.float32(w * shrink), np.float32(x * shrink), np.float32(y * shrink), np.float32(z * shrink)
        a, b, c = scales[i, 0], scales[i, 1], scales[i, 2]
        record = records[i]
        record[AXES + 0] = (_ONE - _TWO * (y * y + z * z)) * a
        record[AXES + 1] = _TWO * (x * y - w * z) * b
        record[AXES + 2] = _TWO * (x * z + w * y) * c
        record[AXES + 3] = _TWO * (x * y + w * z) * a
        record[AXES + 4] = (_ONE - _TWO * (x * x + z * z)) * b
        record[AXES + 5] = _TWO * (y * z - w * x) * c
        record[AXES + 6] = _TWO * (x * z - w * y) * a
        record[AXES + 7] = _TWO * (y * z + w * x) * b
        record[AXES + 8] = (_ONE - _TWO * (x * x + y * y)) * c
        opacity = opacities[i]
        record[LOG_OPACITY] = np.float32(log2(opacity)) if opacity > _ZERO else _NOTHING
        record[13] = record[14] = record[15] = _ZERO
        for axis in range(3):
            record[MEAN + axis] = means[i, axis]
            columns[axis, i] = means[i, axis]
        columns[3, i] = max(a, b, c)
        columns[4, i] = record[LOG_OPACITY]


@kernel
def initial_tiles(width: int, height: int, columns: int, alive: Any, state: Any) -> None:
    """Let light through the pixels of the image, and not through those that only fill the tiles at its edges."""
    for tile in range(len(alive)):
        x, y = tile % columns * TILE, tile // columns * TILE
        mask = np.uint64(0)
        for pixel in range(PIXELS):
            block, lane = pixel >> 3, pixel & 7
            inside = x + (block & 1) * 4 + (lane & 3) < width and y + (block & 6) + (lane >> 2) < height
            state[tile, LIGHT, pixel] = _ONE if inside else _ZERO
            mask |= np.uint64(inside) << np.uint64(pixel)
        alive[tile] = mask


@kernel
def unpack(state: Any, columns: int, background: Any, planes: Any, image: Any) -> bool:
    """From tiles to ``planes`` (3, h, w): depth, accumulated depth, opacity, and ``image`` (h, w, 3) if coloured.

    Returns:
        Whether every number is finite.
    """
    coloured = state.shape[1] == COLOURED
    check: Any = _ZERO
    for y in range(planes.shape[1]):
        for x in range(planes.shape[2]):
            tile = y // TILE * columns + x // TILE
            pixel = ((y & 6) + (x >> 2 & 1)) * 8 + (y & 1) * 4 + (x & 3)
            opacity, accumulated = state[tile, OPACITY, pixel], state[tile, ACCUMULATED, pixel]
            planes[0, y, x] = accumulated / max(opacity, _FLOOR)
            planes[1, y, x] = accumulated
            planes[2, y, x] = opacity
            check += accumulated * _ZERO
            if coloured:
                for channel in range(3):
                    value = state[tile, COLOUR + channel, pixel] + (_ONE - opacity) * background[channel]
                    image[y, x, channel] = value
                    check += value * _ZERO
    return bool(check == _ZERO)


@kernel
def project_all(
    records: Any, harmonics: Any, degree: int, camera: Any, antialiased: bool, scratch: Any, out: Any
) -> None:
    """Project every Gaussian into ``out`` (PROJECTED, n); colours only if ``degree`` is not negative."""
    source, item = scratch.source, scratch.item
    for start in range(0, len(records), CHUNK):
        filled = min(CHUNK, len(records) - start)
        for j in range(filled):
            for row in range(RECORD):
                source[(j >> 3) * (RECORD * 8) + row * 8 + (j & 7)] = records[start + j, row]
        for j in range(0, filled, lanes.WIDTH):
            project_eight(source, j, camera, antialiased, item, scratch.boxes)
        for j in range(filled):
            if degree >= 0:
                colour(harmonics, start + j, degree, camera, source, j, scratch.basis, item)
            for row in range(PROJECTED):
                out[row, start + j] = item[(j >> 3) * (PROJECTED * 8) + row * 8 + (j & 7)]

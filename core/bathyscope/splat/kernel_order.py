"""Kernels: which Gaussians may touch the image, where, and in which order from the camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.splat import lanes
from bathyscope.splat.jit import inlined, kernel
from bathyscope.splat.kernel_project import (
    EPS,
    FAR,
    FOCAL,
    LOG_THRESHOLD,
    NEAR,
    PRINCIPAL,
    SIZE,
    TILT,
    TWO_LN2,
    ZERO,
    along,
)
from bathyscope.splat.lanes import at_least, at_most, load, madd, root, store, store_truncated, wide

U64 = NDArray[np.uint64]

TILE = 8
"""Pixels along the side of a tile: 64 pixels, one bit each."""
DIGIT = 11
"""Most bits that one pass of the sort looks at."""

_MARGIN = np.float32(1.01)


@inlined
def _pixel_range(ends: Any, row: int, centre: Any, reach: Any, side: Any) -> None:
    """Pixels that [centre - reach, centre + reach] meets, in ``row`` and the row after."""
    last = wide(side - np.float32(1))
    store_truncated(ends, row * 8, at_most(at_least(centre - reach, wide(ZERO)), last))
    store_truncated(ends, (row + 1) * 8, at_most(at_least(centre + reach, wide(ZERO)), last))


@kernel
def select(columns: Any, camera: Any, order: Any, boxes: Any, depths: Any, patterns: Any, ends: Any) -> Any:
    """Leave out what cannot touch the image.

    Args:
        columns: (5, n) mean x, y, z, largest standard deviation, log2 of the opacity; n is a multiple of eight.
        camera: From ``camera_numbers``.
        order: (n,) uint64 out: the bits of the depth above the number of the Gaussian, for those that stay.
        boxes: (n,) uint64 out: a box in pixels that holds the Gaussian, 16 bits each: left, right, top, bottom.
        depths: (8,) scratch.
        patterns: The same eight as uint32.
        ends: (4, 8) int32 scratch.

    Returns:
        How many stay.
    """
    n = columns.shape[1]
    width, height = camera[SIZE], camera[SIZE + 1]
    count = np.int64(0)
    for at in range(0, n, 8):
        x, y, z = load(columns, at), load(columns, n + at), load(columns, 2 * n + at)
        depth = along(camera, 2, x, y, z)
        excess = load(columns, 4 * n + at) - camera[LOG_THRESHOLD]
        stays = (depth >= camera[NEAR]) & (depth <= camera[FAR]) & (excess >= ZERO)
        if lanes.bits(stays) == 0:
            continue
        inverse = wide(np.float32(1)) / depth
        u = madd(along(camera, 0, x, y, z) * inverse, wide(camera[FOCAL]), wide(camera[PRINCIPAL]))
        v = madd(along(camera, 1, x, y, z) * inverse, wide(camera[FOCAL + 1]), wide(camera[PRINCIPAL + 1]))
        # No more than the exact reach, whatever the direction of the longest axis.
        sigmas = root(at_least(excess, wide(ZERO)) * TWO_LN2) * _MARGIN
        size = load(columns, 3 * n + at) * inverse
        size_u, size_v = size * (camera[FOCAL] * camera[TILT]), size * (camera[FOCAL + 1] * camera[TILT + 1])
        reach_u, reach_v = (
            sigmas * root(madd(size_u, size_u, wide(camera[EPS]))),
            sigmas * root(madd(size_v, size_v, wide(camera[EPS]))),
        )
        stays = stays & (u + reach_u > ZERO) & (u - reach_u < width)
        stays = stays & (v + reach_v > ZERO) & (v - reach_v < height)
        staying = lanes.bits(stays)
        if staying == 0:
            continue
        store(depths, 0, depth)
        _pixel_range(ends, 0, u, reach_u, width)
        _pixel_range(ends, 2, v, reach_v, height)
        for lane in range(8):
            gaussian = at + lane
            box = ends[0, lane] | ends[1, lane] << 16 | np.int64(ends[2, lane]) << 32 | np.int64(ends[3, lane]) << 48
            boxes[gaussian] = np.uint64(box)
            order[count] = np.uint64(patterns[lane]) << np.uint64(32) | np.uint64(gaussian)
            count += (np.int64(staying) >> lane) & 1
    return count


@kernel
def sort(order: Any, spare: Any, count: int, starts: Any) -> bool:
    """Sort the first ``count`` by their upper 32 bits, stable, least digit first; returns if they end in ``spare``.

    Only the bits in which the depths differ are looked at, in as few passes as they need.
    """
    low, high = np.uint64(0xFFFFFFFF), np.uint64(0)
    for i in range(count):
        key = order[i] >> np.uint64(32)
        low, high = min(low, key), max(high, key)
    differing = 0
    while count > 0 and (high - low) >> np.uint64(differing) != np.uint64(0):
        differing += 1
    passes = (differing + DIGIT - 1) // DIGIT
    if passes == 0:
        return False
    digit = np.uint64((differing + passes - 1) // passes)
    mask = (np.uint64(1) << digit) - np.uint64(1)
    shift = np.uint64(0)
    for _ in range(passes):
        starts[:] = 0
        for i in range(count):
            starts[(((order[i] >> np.uint64(32)) - low) >> shift) & mask] += 1
        total = 0
        for bucket in range(1 << DIGIT):
            size = starts[bucket]
            starts[bucket] = total
            total += size
        for i in range(count):
            bucket = (((order[i] >> np.uint64(32)) - low) >> shift) & mask
            spare[starts[bucket]] = order[i]
            starts[bucket] += 1
        order, spare = spare, order
        shift += digit
    return passes % 2 == 1


def nearest_first(columns: NDArray[np.float32], camera: NDArray[np.float32]) -> tuple[U64, int, U64]:
    """What ``blend`` needs: the order, how many of it count, and a box around each Gaussian."""
    order, spare, boxes = np.empty((3, columns.shape[1]), np.uint64)
    depths = np.empty(8, np.float32)
    count = select(columns, camera, order, boxes, depths, depths.view(np.uint32), np.empty((4, 8), np.int32))
    moved = sort(order, spare, count, np.empty(1 << DIGIT, np.int64))
    return spare if moved else order, count, boxes

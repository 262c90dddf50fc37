"""Kernels: the way back through the blending, in the order of the way there.

A pixel's loss changes with the features f of its image (opacity, depth, colour) as the sum of g_f f. With the weights
w of the Gaussians it is the sum of w G, where G is the sum of g_f over the features of one Gaussian. What a Gaussian
hides of those behind it is the rest of that sum, which is the whole (known from the image) less what has been passed:
one number a pixel, and no list of weights has to be kept.

What a Gaussian gets from its pixels leaves as ten sums: of h = dL/d ln(alpha), of h times the coordinates p and q of
``kernel_project`` and their products, and of the weight times the gradients of depth and colour.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bathyscope.splat import lanes
from bathyscope.splat.jit import inlined, kernel
from bathyscope.splat.kernel_blend import (
    ACROSS,
    BATCH,
    BLOCK_COUNTS,
    BLOCKS,
    DOWN,
    EMPTY,
    NONE,
    PIXELS,
    Scratch,
    alive_pixels,
    blocks_of,
    gather,
    list_by_tile,
    wide_at,
)
from bathyscope.splat.kernel_harmonics import colour
from bathyscope.splat.kernel_harmonics_backward import colour_backward
from bathyscope.splat.kernel_order import TILE
from bathyscope.splat.kernel_project import (
    BLUE,
    CAMERA,
    CHUNK,
    CUTOFF,
    DEPTH,
    EXPONENT,
    GREEN,
    L0,
    L1,
    L2,
    LOG_OPACITY,
    LOG_THRESHOLD,
    MAX_ALPHA,
    PROJECTED,
    RECORD,
    RED,
    ZERO,
    U,
    V,
    project_eight,
)
from bathyscope.splat.kernel_project_backward import (
    SUMS,
    TOUCHED,
    project_eight_backward,
)
from bathyscope.splat.lanes import at_most, load, madd, msub, peek, pick, poke, store, wide

# Planes of a tile: the light that is left, the rest of the sum of w G, and the gradients of the image.
LIGHT, REST, BY_OPACITY, BY_DEPTH, BY_RED, BY_GREEN, BY_BLUE, BACKWARD = range(8)
PLANES = 5
"""Planes of an image that gradients come for: opacity, accumulated depth, red, green, blue."""

_ONE = np.float32(1)


class BackwardScratch(NamedTuple):
    """What ``blend_backward`` works in; one per call."""

    forward: Scratch
    sums: NDArray[np.float32]
    """(CHUNK, SUMS) what the Gaussians of a chunk get from their pixels."""
    by_row: NDArray[np.float32]
    """(CHUNK / 8, SUMS, 8) the same, eight Gaussians together."""
    records: NDArray[np.float32]
    """(CHUNK / 8, RECORD, 8) gradients of the records of a chunk."""
    camera: NDArray[np.float32]
    """(CAMERA, 8) gradients of the camera's numbers, from the Gaussians of a chunk."""
    basis: NDArray[np.float32]
    """(25,) harmonics in one direction."""

    @classmethod
    def of(cls, tiles: int) -> BackwardScratch:
        """Scratch for an image of so many tiles."""
        return cls(
            forward=Scratch.of(tiles),
            sums=np.zeros(CHUNK * SUMS, np.float32),
            by_row=np.zeros(CHUNK * SUMS, np.float32),
            records=np.empty(CHUNK * RECORD, np.float32),
            camera=np.empty(CAMERA * 8, np.float32),
            basis=np.empty(25, np.float32),
        )


@kernel
def backward_tiles(planes: Any, gradients: Any, columns: int, alive: Any, state: Any) -> None:
    """Fill ``state`` (tiles, BACKWARD, PIXELS) from images and their gradients (PLANES, h, w); light as at first."""
    height, width = gradients.shape[1], gradients.shape[2]
    for tile in range(len(alive)):
        left, top = tile % columns * TILE, tile // columns * TILE
        mask = np.uint64(0)
        for pixel in range(PIXELS):
            block, lane = pixel >> 3, pixel & 7
            x, y = left + (block & 1) * 4 + (lane & 3), top + (block & 6) + (lane >> 2)
            inside = x < width and y < height
            state[tile, LIGHT, pixel] = _ONE if inside else ZERO
            mask |= np.uint64(inside) << np.uint64(pixel)
            rest = 0.0
            for plane in range(PLANES):
                gradient = gradients[plane, y, x] if inside else ZERO
                state[tile, BY_OPACITY + plane, pixel] = gradient
                if inside:
                    rest += float(gradient) * planes[plane, y, x]
            state[tile, REST, pixel] = np.float32(rest)
        alive[tile] = mask


@inlined
def _own_gradient(state: Any, place: Any, item: Any, at: Any) -> Any:
    """G of the Gaussian at ``at`` of ``item`` in the eight pixels at ``place``."""
    own = load(state, place + BY_OPACITY * PIXELS)
    own = madd(wide_at(item, at + DEPTH * 8), load(state, place + BY_DEPTH * PIXELS), own)
    own = madd(wide_at(item, at + RED * 8), load(state, place + BY_RED * PIXELS), own)
    own = madd(wide_at(item, at + GREEN * 8), load(state, place + BY_GREEN * PIXELS), own)
    return madd(wide_at(item, at + BLUE * 8), load(state, place + BY_BLUE * PIXELS), own)


@inlined
def _coordinates(place: Any, x: Any, y: Any, item: Any, at: Any) -> Any:
    """Coordinates p and q, and the exponent of alpha, in the eight pixels of block ``place``; as on the way there."""
    dx, dy = load(ACROSS, place) + x, load(DOWN, place) + y
    dx, dy = dx - wide_at(item, at + U * 8), dy - wide_at(item, at + V * 8)
    p = madd(dx, wide_at(item, at + L0 * 8), dy * peek(item, at + L1 * 8))
    q = dy * peek(item, at + L2 * 8)
    return p, q, msub(p, p, msub(q, q, wide_at(item, at + EXPONENT * 8)))


@inlined
def _pass_light(state: Any, place: Any, unbounded: Any, exponent: Any, camera: Any) -> Any:
    """Weight and remaining light in eight pixels, and in which of them light is left; as on the way there."""
    alpha = at_most(unbounded, wide_at(camera, MAX_ALPHA))
    alpha = pick(exponent >= peek(camera, LOG_THRESHOLD), alpha, wide(ZERO))
    light = load(state, place + LIGHT * PIXELS)
    after = msub(alpha, light, light)
    alive = after > peek(camera, CUTOFF)
    store(state, place + LIGHT * PIXELS, pick(alive, after, wide(ZERO)))
    return pick(alive, alpha * light, wide(ZERO)), after, alive


@inlined
def _one_gaussian(state: Any, first: Any, blocks: Any, x: Any, y: Any, item: Any, at: Any, camera: Any) -> Any:
    """Pass one Gaussian on the way back through some blocks of a tile; returns its ten sums, in two vectors."""
    nothing = wide(ZERO)
    h, hp, hq, hpp, hpq, hqq = nothing, nothing, nothing, nothing, nothing, nothing
    depth, red, green, blue = nothing, nothing, nothing, nothing
    for k in range(peek(BLOCK_COUNTS, blocks)):
        block = np.int64(peek(BLOCKS, blocks * 8 + k)) * 8
        place = first + block
        p, q, exponent = _coordinates(block, x, y, item, at)
        unbounded = lanes.exp2(exponent)
        weight, after, alive = _pass_light(state, place, unbounded, exponent, camera)
        passed = weight * _own_gradient(state, place, item, at)
        rest = load(state, place + REST * PIXELS) - passed
        store(state, place + REST * PIXELS, rest)
        # More alpha shows more of this Gaussian and less of the rest; a bounded one does not change.
        moves = alive & (exponent >= peek(camera, LOG_THRESHOLD)) & (unbounded < peek(camera, MAX_ALPHA))
        change = pick(moves, msub(rest, weight / after, passed), nothing)
        by_p, by_q = change * p, change * q
        h, hp, hq = h + change, hp + by_p, hq + by_q
        hpp, hpq, hqq = madd(by_p, p, hpp), madd(by_p, q, hpq), madd(by_q, q, hqq)
        depth = madd(weight, load(state, place + BY_DEPTH * PIXELS), depth)
        red = madd(weight, load(state, place + BY_RED * PIXELS), red)
        green = madd(weight, load(state, place + BY_GREEN * PIXELS), green)
        blue = madd(weight, load(state, place + BY_BLUE * PIXELS), blue)
    most = lanes.sums(h, hp, hq, hpp, hpq, hqq, depth, red)
    return most, lanes.sums(green, blue, nothing, nothing, nothing, nothing, nothing, nothing)


@kernel
def _tile_backward(
    state: Any, tile: int, columns: int, alive: Any, harmonics: Any, degree: int, camera: Any, scratch: Any
) -> Any:
    """Pass the list of a tile; returns the pixels that still let light through."""
    first = tile * BACKWARD * PIXELS
    forward = scratch.forward
    item, has_colour, totals = forward.item, forward.has_colour, scratch.sums
    x, y = wide(np.float32(tile % columns * TILE)), wide(np.float32(tile // columns * TILE))
    entry = np.int64(peek(forward.head, tile))
    poke(forward.head, tile, NONE)
    while entry != NONE and alive != EMPTY:
        live = blocks_of(alive)
        for _ in range(BATCH):
            if entry == NONE:
                break
            blocks = peek(forward.entry_blocks, entry) & live
            j = np.int64(peek(forward.entry_item, entry))
            entry = np.int64(peek(forward.entry_next, entry))
            if blocks == 0:
                continue
            if peek(has_colour, j) == 0:
                poke(has_colour, j, 1)
                colour(harmonics, forward.who[j], degree, camera, forward.source, j, forward.basis, item)
            at = (j >> 3) * (PROJECTED * 8) + (j & 7)
            most, others = _one_gaussian(state, first, blocks, x, y, item, at, camera)
            place = j * SUMS
            store(totals, place, load(totals, place) + most)
            store(totals, place + 8, load(totals, place + 8) + others)
        alive = alive_pixels(state, first)
    return alive


@kernel
def _chunk_backward(
    filled: int, harmonics: Any, degree: int, camera: Any, antialiased: bool, scratch: Any, gradients: Any
) -> None:
    """From the sums of the Gaussians of a chunk to the gradients of records, harmonics and camera."""
    forward, totals, by_row = scratch.forward, scratch.sums, scratch.by_row
    records, by_harmonics, by_camera = gradients
    who, has_colour = forward.who, forward.has_colour
    rounded = (filled + 7) // 8 * 8
    for j in range(rounded):
        touched = j < filled and has_colour[j] != 0
        place = (j >> 3) * (SUMS * 8) + (j & 7)
        if touched:
            colour_backward(
                harmonics, who[j], degree, camera, forward.source, j, forward.item, totals, scratch.basis, by_harmonics
            )
        for row in range(SUMS):
            by_row[place + row * 8] = totals[j * SUMS + row] if touched else ZERO
            totals[j * SUMS + row] = ZERO
        by_row[place + TOUCHED * 8] = _ONE if touched else ZERO
    scratch.camera[:] = ZERO
    for j in range(0, rounded, lanes.WIDTH):
        project_eight_backward(
            forward.source, forward.item, by_row, j, camera, antialiased, scratch.records, scratch.camera
        )
    for j in range(filled):
        if has_colour[j] != 0:
            record, place = who[j] * RECORD, (j >> 3) * (RECORD * 8) + (j & 7)
            for row in range(LOG_OPACITY + 1):
                poke(records, record + row, peek(records, record + row) + peek(scratch.records, place + row * 8))
    for number in range(CAMERA):
        total = 0.0
        for lane in range(lanes.WIDTH):
            total += scratch.camera[number * 8 + lane]
        by_camera[number] += total


@kernel
def blend_backward(
    order: Any,
    count: int,
    pixel_boxes: Any,
    records: Any,
    harmonics: Any,
    degree: int,
    camera: Any,
    antialiased: bool,
    alive: Any,
    columns: int,
    state: Any,
    scratch: Any,
    gradients: Any,
) -> None:
    """Add the gradients that one view gives to the Gaussians and its camera.

    Args:
        order: As ``blend``, like all that has the same name there.
        count: How many of ``order`` count.
        pixel_boxes: From ``kernel_order.select``.
        records: (n, RECORD).
        harmonics: (n, k, 3).
        degree: Degree of the harmonics that were evaluated.
        camera: From ``camera_numbers``.
        antialiased: Whether opacities are compensated.
        alive: (tiles,) from ``backward_tiles``.
        columns: Tiles along the width.
        state: (tiles, BACKWARD, PIXELS) from ``backward_tiles``.
        scratch: A ``BackwardScratch`` for as many tiles.
        gradients: Added to: of records (n, RECORD), with the last as dL/d ln(opacity); of harmonics (n, k, 3); and
            of the camera's numbers (CAMERA,), float64.
    """
    forward = scratch.forward
    unfinished = 0
    for tile in range(len(alive)):
        unfinished += alive[tile] != EMPTY
    reach = 3 * (degree + 1) * (degree + 1)
    at = 0
    while at < count and unfinished > 0:
        at, filled = gather(order, at, count, pixel_boxes, records, alive, columns, forward)
        for j in range(0, filled, lanes.WIDTH):
            project_eight(forward.source, j, camera, antialiased, forward.item, forward.boxes)
        for j in range(filled):
            forward.has_colour[j] = 0
        j = 0
        while j < filled:
            j, touched = list_by_tile(j, filled, alive, columns, harmonics, reach, forward)
            for k in range(touched):
                tile = forward.touched[k]
                left = _tile_backward(state, tile, columns, alive[tile], harmonics, degree, camera, scratch)
                alive[tile] = left
                unfinished -= left == EMPTY
        _chunk_backward(filled, harmonics, degree, camera, antialiased, scratch, gradients)

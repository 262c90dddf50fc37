"""Kernels: blending Gaussians into the image, front to back.

The image is kept as tiles of 8x8 pixels, and a tile as eight blocks of 4x2 pixels: one vector each. A tile has a
64-bit mask of the pixels that still let light through. Gaussians come a chunk at a time, nearest first; those that
meet finished pixels only are dropped before they are projected, the others are listed per tile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bathyscope.splat import lanes
from bathyscope.splat.jit import inlined, kernel
from bathyscope.splat.kernel_harmonics import colour
from bathyscope.splat.kernel_order import TILE
from bathyscope.splat.kernel_project import (
    BLUE,
    BOTTOM,
    BOX,
    CHUNK,
    CUTOFF,
    DEPTH,
    EXPONENT,
    GREEN,
    L0,
    L1,
    L2,
    LEFT,
    LOG_OPACITY,
    LOG_THRESHOLD,
    MAX_ALPHA,
    MEAN,
    PROJECTED,
    RECORD,
    RED,
    RIGHT,
    TOP,
    ZERO,
    U,
    V,
    project_eight,
)
from bathyscope.splat.lanes import at_most, load, madd, msub, peek, pick, poke, store, wide

# Planes of a tile; light that is left, blended opacity and depth, and colour where it is asked for.
LIGHT, OPACITY, ACCUMULATED, COLOUR = range(4)
PLAIN, COLOURED = 3, 6
PIXELS = TILE * TILE
AHEAD = 24
"""Records fetched ahead of their turn."""
BATCH = 32
"""Gaussians blended into a tile before asking which of its blocks are finished."""
LINE = 16
"""float32 in a cache line."""
NONE = -1


def _masks() -> tuple[Any, Any]:
    """Masks of the columns, and of the rows, from a first to a last one: entry 8 * first + last."""
    row, column = np.divmod(np.arange(PIXELS), TILE)
    bit = (row // 2 * 2 + column // 4) * 8 + row % 2 * 4 + column % 4
    tables = []
    for place in (column, row):
        table = np.zeros(PIXELS, np.uint64)
        for first in range(TILE):
            for last in range(first, TILE):
                chosen = bit[(place >= first) & (place <= last)]
                table[first * TILE + last] = np.bitwise_or.reduce(np.uint64(1) << chosen.astype(np.uint64))
        tables.append(table)
    return tables[0], tables[1]


def _blocks() -> tuple[Any, Any]:
    """For each set of blocks, a byte: their numbers, and how many they are."""
    numbers = np.zeros((256, 8), np.int32)
    for chosen in range(256):
        members = [block for block in range(8) if chosen >> block & 1]
        numbers[chosen, : len(members)] = members
    return numbers, np.array([bin(chosen).count("1") for chosen in range(256)], np.int64)


COLUMN_MASKS, ROW_MASKS = _masks()
BLOCKS, BLOCK_COUNTS = _blocks()
# Centres of the pixels of a tile, block by block, from the corner of the tile.
ACROSS = np.array([(b % 2) * 4 + lane % 4 + 0.5 for b in range(8) for lane in range(8)], np.float32)
DOWN = np.array([(b // 2) * 2 + lane // 4 + 0.5 for b in range(8) for lane in range(8)], np.float32)
EMPTY = np.uint64(0)
_FIRST_OF_EACH, _GATHER_BITS = np.uint64(0x0101010101010101), np.uint64(0x0102040810204080)


class Scratch(NamedTuple):
    """What ``blend`` works in; one per call, so that calls do not meet."""

    source: NDArray[np.float32]
    """(CHUNK / 8 * RECORD * 8,) records of a chunk: eight Gaussians together, row by row."""
    item: NDArray[np.float32]
    """(CHUNK / 8 * PROJECTED * 8,)"""
    boxes: NDArray[np.int32]
    """(CHUNK / 8 * BOX * 8,)"""
    who: NDArray[np.int64]
    """(CHUNK,) numbers of the Gaussians in the scene."""
    has_colour: NDArray[np.uint8]
    """(CHUNK,)"""
    basis: NDArray[np.float32]
    """(25,) harmonics in one direction."""
    entry_item: NDArray[np.int32]
    """Linked lists of the Gaussians of each tile, which cost the same however many tiles there are."""
    entry_next: NDArray[np.int32]
    entry_blocks: NDArray[np.uint8]
    """The blocks of the tile that the Gaussian may touch, a bit each."""
    head: NDArray[np.int32]
    """(tiles,) first entry; ``NONE`` between chunks."""
    tail: NDArray[np.int32]
    touched: NDArray[np.int32]
    """(tiles,) the tiles that have a list."""

    work: NDArray[np.int32]
    """((BATCH + 1) * 8,) eight times the place of a Gaussian in ``item``, plus the block to blend it into."""

    @classmethod
    def of(cls, tiles: int) -> Scratch:
        """Scratch for an image of so many tiles."""
        room = 4 * CHUNK + tiles
        return cls(
            source=np.zeros(CHUNK * RECORD, np.float32),
            item=np.empty(CHUNK * PROJECTED, np.float32),
            boxes=np.empty(CHUNK * BOX, np.int32),
            who=np.empty(CHUNK, np.int64),
            has_colour=np.empty(CHUNK, np.uint8),
            basis=np.empty(25, np.float32),
            entry_item=np.empty(room, np.int32),
            entry_next=np.empty(room, np.int32),
            entry_blocks=np.empty(room, np.uint8),
            head=np.full(tiles, NONE, np.int32),
            tail=np.empty(tiles, np.int32),
            touched=np.empty(tiles, np.int32),
            work=np.empty((BATCH + 1) * 8, np.int32),
        )


@inlined
def _box_mask(left: Any, right: Any, top: Any, bottom: Any, row: int, column: int) -> Any:
    """The pixels of a tile that lie in a box of the image, both ends included."""
    x, y = column * TILE, row * TILE
    across = max(left - x, 0) * TILE + min(right - x, TILE - 1)
    down = max(top - y, 0) * TILE + min(bottom - y, TILE - 1)
    return peek(COLUMN_MASKS, across) & peek(ROW_MASKS, down)


@inlined
def blocks_of(mask: Any) -> Any:
    """The blocks with a pixel in ``mask``, a bit each."""
    mask |= mask >> np.uint64(4)
    mask |= mask >> np.uint64(2)
    mask |= mask >> np.uint64(1)
    return np.int64((mask & _FIRST_OF_EACH) * _GATHER_BITS >> np.uint64(56))


@inlined
def wide_at(array: Any, index: Any) -> Any:
    return wide(peek(array, index))


@inlined
def _blend_block(state: Any, place: Any, dx: Any, dy: Any, item: Any, at: Any, camera: Any, coloured: bool) -> None:
    """Blend the Gaussian at ``at`` of ``item`` into the eight pixels at ``place``, whose centres are (dx, dy)."""
    dx, dy = dx - wide_at(item, at + U * 8), dy - wide_at(item, at + V * 8)
    p = madd(dx, wide_at(item, at + L0 * 8), dy * peek(item, at + L1 * 8))
    q = dy * peek(item, at + L2 * 8)
    exponent = msub(p, p, msub(q, q, wide_at(item, at + EXPONENT * 8)))
    alpha = at_most(lanes.exp2(exponent), wide_at(camera, MAX_ALPHA))
    alpha = pick(exponent >= peek(camera, LOG_THRESHOLD), alpha, wide(ZERO))
    light = load(state, place)
    after = msub(alpha, light, light)
    alive = after > peek(camera, CUTOFF)
    # A finished pixel lets no light through, so nothing is added to it any more.
    weight = pick(alive, alpha * light, wide(ZERO))
    store(state, place, pick(alive, after, wide(ZERO)))
    place += PIXELS
    store(state, place, load(state, place) + weight)
    place += PIXELS
    store(state, place, madd(weight, wide_at(item, at + DEPTH * 8), load(state, place)))
    if coloured:
        place += PIXELS
        store(state, place, madd(weight, wide_at(item, at + RED * 8), load(state, place)))
        place += PIXELS
        store(state, place, madd(weight, wide_at(item, at + GREEN * 8), load(state, place)))
        place += PIXELS
        store(state, place, madd(weight, wide_at(item, at + BLUE * 8), load(state, place)))


@inlined
def alive_pixels(state: Any, first: int) -> Any:
    """The pixels that let light through of the tile whose numbers start at ``first``."""
    mask = EMPTY
    for block in range(8):
        light = load(state, first + block * 8)
        mask |= lanes.bits(light > ZERO) << np.uint64(block * 8)
    return mask


@kernel
def _blend_tile(
    state: Any, tile: int, columns: int, alive: Any, harmonics: Any, degree: int, camera: Any, scratch: Any
) -> Any:
    """Blend the list of a tile into it; returns the pixels that still let light through.

    The list is first turned into a plain one of (Gaussian, block), a batch at a time: a loop over that has no
    branch to mispredict. Which blocks are finished is looked at between batches.
    """
    coloured = state.shape[1] == COLOURED
    first = tile * state.shape[1] * PIXELS
    item, work, has_colour = scratch.item, scratch.work, scratch.has_colour
    x, y = wide(np.float32(tile % columns * TILE)), wide(np.float32(tile // columns * TILE))
    entry = np.int64(peek(scratch.head, tile))
    poke(scratch.head, tile, NONE)
    while entry != NONE and alive != EMPTY:
        live = blocks_of(alive)
        count = 0
        for _ in range(BATCH):
            if entry == NONE:
                break
            blocks = peek(scratch.entry_blocks, entry) & live
            j = np.int64(peek(scratch.entry_item, entry))
            entry = np.int64(peek(scratch.entry_next, entry))
            if coloured and peek(has_colour, j) == 0 and blocks != 0:
                poke(has_colour, j, 1)
                colour(harmonics, scratch.who[j], degree, camera, scratch.source, j, scratch.basis, item)
            lanes.write_numbers(work, count, BLOCKS, blocks, (j >> 3) * (PROJECTED * 64) + (j & 7) * 8)
            count += peek(BLOCK_COUNTS, blocks)
        for k in range(count):
            what = np.int64(peek(work, k))
            block = (what & 7) * 8
            dx, dy = load(ACROSS, block) + x, load(DOWN, block) + y
            _blend_block(state, first + block, dx, dy, item, what >> 3, camera, coloured)
        alive = alive_pixels(state, first)
    return alive


@kernel
def blend(
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
) -> None:
    """Blend the first ``count`` of ``order`` into ``state``.

    Args:
        order: Sorted Gaussians, from ``kernel_order.sort``.
        count: How many.
        pixel_boxes: From ``kernel_order.select``.
        records: (n, RECORD).
        harmonics: (n, k, 3); not read unless ``state`` has colour.
        degree: Degree of the harmonics to evaluate.
        camera: From ``camera_numbers``.
        antialiased: Whether opacities are compensated.
        alive: (tiles,) masks of the pixels that let light through.
        columns: Tiles along the width.
        state: (tiles, PLAIN or COLOURED, PIXELS).
        scratch: A ``Scratch`` for as many tiles.
    """
    tiles = len(alive)
    unfinished = 0
    for tile in range(tiles):
        unfinished += alive[tile] != EMPTY
    reach = 3 * (degree + 1) * (degree + 1) if state.shape[1] == COLOURED else 0
    at = 0
    while at < count and unfinished > 0:
        at, filled = gather(order, at, count, pixel_boxes, records, alive, columns, scratch)
        for j in range(0, filled, lanes.WIDTH):
            project_eight(scratch.source, j, camera, antialiased, scratch.item, scratch.boxes)
        for j in range(filled):
            scratch.has_colour[j] = 0
        j = 0
        while j < filled:
            j, touched = list_by_tile(j, filled, alive, columns, harmonics, reach, scratch)
            for k in range(touched):
                tile = scratch.touched[k]
                left = _blend_tile(state, tile, columns, alive[tile], harmonics, degree, camera, scratch)
                alive[tile] = left
                unfinished -= left == EMPTY


@kernel
def gather(
    order: Any, at: int, count: int, pixel_boxes: Any, records: Any, alive: Any, columns: int, scratch: Any
) -> Any:
    """Copy records, from ``order[at]`` on, of Gaussians that meet an unfinished tile; returns where it stopped."""
    who = scratch.who
    filled = 0
    low = np.uint64(0xFFFFFFFF)
    while at < count and filled < CHUNK:
        if at + AHEAD < count:
            lanes.prefetch(pixel_boxes, np.int64(peek(order, at + AHEAD) & low))
        gaussian = np.int64(peek(order, at) & low)
        at += 1
        box = np.int64(peek(pixel_boxes, gaussian))
        left, right = box & 0xFFFF, box >> 16 & 0xFFFF
        top, bottom = box >> 32 & 0xFFFF, box >> 48
        live = EMPTY
        for row in range(top >> 3, (bottom >> 3) + 1):
            for column in range(left >> 3, (right >> 3) + 1):
                live |= peek(alive, row * columns + column) & _box_mask(left, right, top, bottom, row, column)
            if live != EMPTY:
                break
        if live != EMPTY:
            poke(who, filled, gaussian)
            lanes.prefetch(records, gaussian * RECORD)
            filled += 1
    for j in range(filled):
        record, place = peek(who, j) * RECORD, (j >> 3) * (RECORD * 8) + (j & 7)
        for row in range(MEAN, LOG_OPACITY + 1):
            poke(scratch.source, place + row * 8, peek(records, record + row))
    return at, filled


@kernel
def list_by_tile(j: int, filled: int, alive: Any, columns: int, harmonics: Any, reach: int, scratch: Any) -> Any:
    """List the Gaussians of a chunk, from ``j`` on, per tile, while there is room; returns where it stopped.

    The first ``reach`` numbers of the harmonics of those that are listed are fetched, for their colour.
    """
    boxes, head, tail = scratch.boxes, scratch.head, scratch.tail
    entries, touched = 0, 0
    room = len(scratch.entry_item) - len(alive)
    while j < filled and entries < room:
        place = (j >> 3) * (BOX * 8) + (j & 7)
        left, right = np.int64(peek(boxes, place + LEFT * 8)), np.int64(peek(boxes, place + RIGHT * 8))
        top, bottom = np.int64(peek(boxes, place + TOP * 8)), np.int64(peek(boxes, place + BOTTOM * 8))
        if left <= right and top <= bottom:
            before = entries
            for row in range(top >> 3, (bottom >> 3) + 1):
                for column in range(left >> 3, (right >> 3) + 1):
                    tile = row * columns + column
                    mask = peek(alive, tile) & _box_mask(left, right, top, bottom, row, column)
                    if mask == EMPTY:
                        continue
                    if peek(head, tile) == NONE:
                        poke(head, tile, entries)
                        poke(scratch.touched, touched, tile)
                        touched += 1
                    else:
                        poke(scratch.entry_next, np.int64(peek(tail, tile)), entries)
                    poke(tail, tile, entries)
                    poke(scratch.entry_item, entries, j)
                    poke(scratch.entry_next, entries, NONE)
                    poke(scratch.entry_blocks, entries, blocks_of(mask))
                    entries += 1
            if entries > before:
                start = peek(scratch.who, j) * (harmonics.shape[1] * 3)
                for line in range(0, reach, LINE):
                    lanes.prefetch(harmonics, start + line)
        j += 1
    return j, touched

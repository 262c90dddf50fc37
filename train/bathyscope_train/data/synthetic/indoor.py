"""A room with furniture, at the scale of a doll's house: so that not every picture is a tube.

Walls, floor and ceiling are one box seen from inside; tables, cupboards, shelves, papers, cups and lamps stand
and hang in it. The light hangs in the room, not on the camera.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import MaterialRanges
from bathyscope_train.data.synthetic.scene import NOTHING, Scene, Stage, Surface, Tissue, make_surface
from bathyscope_train.data.synthetic.solids import (
    BALL,
    BOX,
    CLOUDS,
    COLLAGE,
    FRUSTUM,
    PLAIN,
    PRINT,
    ROOM,
    STRIPES,
    TILES,
    WOOD,
    Look,
    Part,
    make_solids,
)

Array = npt.NDArray[np.float64]

METRE = 40.0
"""Millimetres of the scene a metre of the room."""


class _Site(NamedTuple):
    """A level face to put things on: its middle, half its sides, its height (y points down)."""

    x: float
    z: float
    half_x: float
    half_z: float
    y: float


def indoor(random: np.random.Generator, _material: MaterialRanges) -> Scene:
    """A kitchen, office or desk; its paints are not those of tissue."""
    half = random.uniform((1.4, 1.15, 1.6), (2.8, 1.5, 3.2)) * METRE
    floor = float(half[1])
    parts = [Part(ROOM, np.eye(4), _triple(half), _wall(random))]
    parts.append(_box((0.0, floor - 0.01 * METRE, 0.0), (half[0], 0.01 * METRE, half[2]), _ground(random)))
    sites: list[_Site] = []
    for _ in range(int(random.integers(1, 4))):
        pieces, site = _table(random, half)
        parts += pieces
        sites.append(site)
    for side in range(3):
        if random.uniform() < 0.75:
            pieces, found = _along_wall(random, half, side)
            parts += pieces
            sites += found
    for _ in range(int(random.integers(5, 18))):
        parts.append(_poster(random, half))
    for site in sites:
        for _ in range(int(random.integers(2, 8))):
            parts.append(_object(random, site))
    for _ in range(int(random.integers(0, 4))):
        parts += _chair(random, half)
    count = int(random.integers(1, 4))
    lights = np.zeros((count, 4))
    lights[:, :3] = random.uniform((-0.8, -0.95, -0.8), (0.8, -0.75, 0.8), (count, 3)) * half
    lights[:, 3] = random.uniform(0.4, 1.2, count) / count
    solids = make_solids(
        parts, lights=lights, reach_mm=float(half[1]) * 1.5, sky=random.uniform(0.12, 0.5), lamp_share=0.0
    )
    close = random.uniform() < 0.35  # over a desk, or into the room
    site = sites[int(random.integers(len(sites)))]
    stage = Stage(
        target=(site.x, site.y, site.z) if close else (0.0, 0.35 * floor, 0.55 * float(half[2])),
        spread_mm=(0.3 * site.half_x, 0.0, 0.3 * site.half_z) if close else (0.3 * half[0], 0.2 * floor, 0.2 * half[2]),
        distance_mm=(0.5 * METRE, 1.3 * METRE) if close else (1.2 * METRE, 3.4 * METRE),
        slant_deg=(0.0, 38.0),
        margin_mm=0.12 * METRE,
        back=(0.0, -0.75, -0.65) if close else (0.0, -0.3, -0.95),
        upright=True,
    )
    return Scene("indoor", _no_surface(), _no_tissue(), solids, stage)


def _no_surface() -> Surface:
    heights = np.zeros((8, 8), np.float32)
    return make_surface(NOTHING, heights, first=(0.0, 0.0), step=(1.0, 1.0), stride_mm=1.0, feature_mm=1.0)


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _colour(random: np.random.Generator, strength: float = 1.0) -> tuple[float, float, float]:
    """A paint: grey, or of any hue."""
    value = random.uniform(0.02, 0.95)
    hue, tint = random.uniform(0, 2 * np.pi), strength * random.uniform(0.0, 1.0)
    shares = 1.0 - tint * (0.5 + 0.5 * np.cos(hue + np.array([0.0, 2.1, 4.2])))
    return _triple(np.clip(value * shares, 0.01, 0.95))


def _look(random: np.random.Generator, kinds: tuple[int, ...], grain: tuple[float, float], strength: float) -> Look:
    return Look(
        _colour(random, strength),
        _colour(random, strength),
        pattern=kinds[int(random.integers(len(kinds)))],
        grain_mm=random.uniform(*grain) * METRE,
        contrast=random.uniform(0.15, 1.0),
        specular=random.uniform(0.0, 0.12),
        shininess=random.uniform(5.0, 40.0),
    )


def _wall(random: np.random.Generator) -> Look:
    look = _look(random, (PLAIN, CLOUDS, CLOUDS, TILES), (0.1, 0.5), 0.5)
    pale = tuple(0.35 + 0.6 * value for value in look.colour)
    other = tuple(0.75 * value for value in pale)
    return look._replace(colour=pale, other=other, contrast=random.uniform(0.1, 0.6), specular=0.0)  # type: ignore[arg-type]


def _wood(random: np.random.Generator) -> Look:
    bright = random.uniform(0.12, 0.75)
    colour = np.array([bright, bright * random.uniform(0.55, 0.75), bright * random.uniform(0.25, 0.5)])
    return Look(
        _triple(colour),
        _triple(colour * random.uniform(0.35, 0.8)),
        WOOD,
        random.uniform(0.06, 0.15) * METRE,
        random.uniform(0.4, 1.0),
        random.uniform(0.0, 0.12),
        random.uniform(8.0, 30.0),
    )


def _ground(random: np.random.Generator) -> Look:
    if random.uniform() < 0.4:
        return _wood(random)
    return _look(random, (CLOUDS, TILES, TILES, COLLAGE), (0.1, 0.5), 0.4)


def _box(middle: tuple[float, float, float], half: tuple[float, ...], look: Look, turn: float = 0.0) -> Part:
    """A box on the level, turned about the vertical."""
    frame = np.eye(4)
    frame[0, 0] = frame[2, 2] = np.cos(turn)
    frame[0, 2], frame[2, 0] = np.sin(turn), -np.sin(turn)
    frame[:3, 3] = middle
    return Part(BOX, frame, (float(half[0]), float(half[1]), float(half[2])), look)


def _table(random: np.random.Generator, half: Array) -> tuple[list[Part], _Site]:
    wide, deep = random.uniform((0.4, 0.3), (0.95, 0.6)) * METRE
    x = random.uniform(-0.9, 0.9) * max(0.0, half[0] - wide - 0.3 * METRE)
    z = random.uniform(-0.5, 0.9) * max(0.0, half[2] - deep - 0.3 * METRE)
    top, thick = float(half[1]) - random.uniform(0.6, 0.95) * METRE, random.uniform(0.012, 0.03) * METRE
    look = _wood(random) if random.uniform() < 0.6 else _look(random, (PLAIN, CLOUDS), (0.05, 0.3), 0.6)
    parts = [_box((x, top + thick, z), (wide, thick, deep), look)]
    leg = random.uniform(0.015, 0.04) * METRE
    tall = (float(half[1]) - top) / 2
    for sx in (-1, 1):
        for sz in (-1, 1):
            place = (x + sx * (wide - 2 * leg), top + tall, z + sz * (deep - 2 * leg))
            parts.append(_box(place, (leg, tall - thick, leg), look))
    return parts, _Site(x, z, wide, deep, top)


def _along_wall(random: np.random.Generator, half: Array, side: int) -> tuple[list[Part], list[_Site]]:
    """A row of cupboards at the far, left or right wall, with boards or cupboards above."""
    deep, tall = random.uniform((0.15, 0.35), (0.35, 0.5)) * METRE
    length = random.uniform(0.3, 0.95)
    look = _look(random, (PLAIN, PLAIN, TILES, CLOUDS), (0.4, 0.9), 1.0)
    sites = []

    def row(y: float, high: float, depth: float, material: Look) -> Part:
        if side == 0:
            return _box((0.0, y, half[2] - depth), (length * half[0], high, depth), material)
        sign = -1.0 if side == 1 else 1.0
        return _box((sign * (half[0] - depth), y, 0.0), (depth, high, length * half[2]), material)

    parts = [row(half[1] - tall, tall, deep, look)]
    size = (length * half[0], deep) if side == 0 else (deep, length * half[2])
    base = parts[0].scene_from_local[:3, 3]
    sites.append(_Site(float(base[0]), float(base[2]), float(size[0]), float(size[1]), float(half[1] - 2 * tall)))
    above = random.uniform()
    if above < 0.4:
        high = random.uniform(0.15, 0.4) * METRE
        parts.append(row(-random.uniform(0.0, 0.4) * half[1] - high, high, 0.6 * deep, look))
    elif above < 0.8:
        board = _wood(random) if random.uniform() < 0.5 else look
        for level in range(int(random.integers(1, 4))):
            y = -(0.05 + 0.33 * level) * METRE
            parts.append(row(y, 0.012 * METRE, 0.6 * deep, board))
            shelf = parts[-1].scene_from_local[:3, 3]
            share = (0.9 * length * half[0], 0.3 * deep) if side == 0 else (0.3 * deep, 0.9 * length * half[2])
            sites.append(_Site(float(shelf[0]), float(shelf[2]), float(share[0]), float(share[1]), y - 0.012 * METRE))
    return parts, sites


def _poster(random: np.random.Generator, half: Array) -> Part:
    """Paper, a picture, a screen or a door on a wall."""
    wide, tall = random.uniform((0.06, 0.08), (0.45, 0.4)) * METRE
    side = int(random.integers(3))
    look = _look(random, (PRINT, COLLAGE, COLLAGE, CLOUDS, STRIPES), (0.015, 0.12), 1.0)
    if look.pattern == PRINT:
        look = look._replace(colour=(0.85, 0.85, 0.82), other=(0.03, 0.03, 0.05), contrast=1.0)
    y = random.uniform(-0.8, 0.2) * half[1]
    thin = 0.006 * METRE
    if side == 0:
        return _box((random.uniform(-0.9, 0.9) * (half[0] - wide), y, half[2] - thin), (wide, tall, thin), look)
    x = (half[0] - thin) * (1.0 if side == 1 else -1.0)
    return _box((x, y, random.uniform(-0.5, 0.9) * (half[2] - wide)), (thin, tall, wide), look)


def _object(random: np.random.Generator, site: _Site) -> Part:
    """Something on a table: a sheet, a book, a box, a cup, a bottle, a ball."""
    x = site.x + random.uniform(-0.85, 0.85) * site.half_x
    z = site.z + random.uniform(-0.85, 0.85) * site.half_z
    turn = random.uniform(-np.pi, np.pi)
    kind = random.choice(["sheet", "book", "box", "cup", "ball"], p=[0.22, 0.22, 0.26, 0.24, 0.06])
    look = _look(random, (PLAIN, PLAIN, CLOUDS, COLLAGE, STRIPES), (0.02, 0.1), 1.0)
    if kind == "sheet":
        paper = Look((0.85, 0.85, 0.83), _colour(random), PRINT, random.uniform(0.008, 0.02) * METRE)
        paper = paper if random.uniform() < 0.6 else look._replace(pattern=COLLAGE)
        thin = random.uniform(0.001, 0.004) * METRE
        return _box((x, site.y - thin, z), (0.105 * METRE, thin, 0.15 * METRE), paper, turn)
    if kind == "ball":
        radius = random.uniform(0.03, 0.1) * METRE
        return Part(BALL, _moved(x, site.y - radius, z), (radius,) * 3, look)
    if kind == "cup":
        radius, tall = random.uniform((0.03, 0.04), (0.07, 0.17)) * METRE
        frame = _moved(x, site.y - tall, z)
        frame[:3, 1], frame[:3, 2] = (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)
        return Part(FRUSTUM, frame, (radius * random.uniform(0.6, 1.1), radius, tall), look)
    sides = random.uniform((0.04, 0.04, 0.04), (0.25, 0.22, 0.2)) * METRE
    if kind == "book":
        sides = np.array([0.09, random.uniform(0.006, 0.03), 0.13]) * METRE
    return _box((x, site.y - float(sides[1]), z), _triple(sides), look, turn)


def _moved(x: float, y: float, z: float) -> Array:
    frame = np.eye(4)
    frame[:3, 3] = x, y, z
    return frame


def _chair(random: np.random.Generator, half: Array) -> list[Part]:
    x, z = random.uniform(-0.7, 0.7) * half[0], random.uniform(-0.4, 0.8) * half[2]
    look = _wood(random) if random.uniform() < 0.5 else _look(random, (PLAIN, CLOUDS), (0.05, 0.2), 1.0)
    wide, seat, thick = 0.2 * METRE, float(half[1]) - 0.45 * METRE, 0.02 * METRE
    parts = [_box((x, seat, z), (wide, thick, wide), look)]
    back = -1.0 if random.uniform() < 0.5 else 1.0
    tall = random.uniform(0.15, 0.3) * METRE
    parts.append(_box((x, seat - tall, z + back * wide), (wide, tall, thick), look))
    for sx in (-1, 1):
        for sz in (-1, 1):
            place = (x + 0.9 * sx * wide, seat + 0.22 * METRE, z + 0.9 * sz * wide)
            parts.append(_box(place, (0.02 * METRE, 0.22 * METRE, 0.02 * METRE), look))
    return parts


def _no_tissue() -> Tissue:
    """The kernel wants a material even where nothing is made of it."""
    blank = np.zeros((2, 2), np.float32)
    return Tissue(
        albedo=np.full((8, 8, 3), 0.5, np.float32),
        vessels=(blank, blank, blank, blank),
        vessel_step_mm=1.0,
        vessel_tint=(1.0, 1.0, 1.0),
        solid=np.zeros((2, 2, 2, 5), np.float32),
        solid_step_mm=1.0,
        mottle=0.0,
        spots=0.0,
        bump=0.0,
        specular=0.0,
        shininess=1.0,
    )

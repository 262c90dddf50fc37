"""Instruments that pass through the view: a shaft with a tip, in from outside, on a path of its own."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.solid_tracing import solid_clearance
from bathyscope_train.data.synthetic.solids import (
    BALL,
    BOX,
    FRUSTUM,
    NO_SOLIDS,
    PLAIN,
    STRIPES,
    Look,
    Part,
    Solids,
    frame_towards,
    make_solids,
    placed,
)

Array = npt.NDArray[np.float64]

_SHAFTS = (
    Look((0.5, 0.5, 0.52), specular=0.5, shininess=18.0, metal=0.85),  # steel
    Look((0.02, 0.02, 0.022), specular=0.12, shininess=25.0),  # black sleeve
    Look((0.75, 0.75, 0.72), specular=0.1, shininess=20.0),  # white catheter
    Look((0.05, 0.22, 0.5), specular=0.15, shininess=30.0),  # blue catheter
    Look((0.1, 0.38, 0.22), specular=0.15, shininess=30.0),
    Look((0.55, 0.45, 0.08), specular=0.1, shininess=20.0),
)
_STEEL = Look((0.55, 0.55, 0.56), specular=0.6, shininess=14.0, metal=0.8)


class Instruments(NamedTuple):
    """The movers of a clip."""

    solids: Solids
    """Parts in their mover's own frame: the tip at the origin, the shaft towards -z."""
    scene_from_mover: Array
    """``(t, m, 4, 4)``"""


NO_INSTRUMENTS = Instruments(NO_SOLIDS, np.zeros((1, 0, 4, 4)))


def draw_instruments(
    random: np.random.Generator,
    scene_from_camera: Array,
    slopes: tuple[float, float],
    reach: Callable[[float, float], float],
) -> Instruments:
    """One instrument, at times two.

    Args:
        random: Source of every choice.
        scene_from_camera: ``(t, 4, 4)``
        slopes: x / z at the right edge of the image, y / z at its lower edge.
        reach: z-depth of the tissue that the first camera sees at a slope (x / z, y / z).
    """
    parts, paths = [], []
    for mover in range(1, 3 if random.uniform() < 0.25 else 2):
        pieces, path = _instrument(random, mover, scene_from_camera, slopes, reach)
        parts += pieces
        paths.append(path)
    return Instruments(make_solids(parts), np.stack(paths, axis=1))


def _instrument(
    random: np.random.Generator,
    mover: int,
    scene_from_camera: Array,
    slopes: tuple[float, float],
    reach: Callable[[float, float], float],
) -> tuple[list[Part], Array]:
    """Parts and path ``(t, 4, 4)`` of one instrument."""
    target = random.uniform(-0.55, 0.55, 2) * slopes
    depth = reach(float(target[0]), float(target[1])) * random.uniform(0.4, 0.85)
    tip = depth * np.append(target, 1.0)
    side = random.uniform(0, 2 * np.pi)
    beside = depth * max(slopes) * random.uniform(1.0, 1.5)
    entry = np.array([beside * np.cos(side), beside * np.sin(side), depth * random.uniform(-0.1, 0.4)])
    radius = depth * max(slopes) * random.uniform(0.035, 0.1)
    length = 2.0 * float(np.linalg.norm(tip - entry))
    pieces = [Part(kind, frame, size, look, mover) for kind, frame, size, look in _shape(random, radius, length)]
    table = make_solids(pieces)
    for calm in (1.0, 0.4, 0.0):
        for rides in random.permutation([True, False]):  # with the endoscope, or held still in the scene
            path = _motion(random, scene_from_camera, tip, entry, calm, rides=bool(rides))
            gap = min(
                solid_clearance(placed(table._replace(mover=np.ones_like(table.mover)), pose[None]), *camera[:3, 3])
                for pose, camera in zip(path, scene_from_camera, strict=True)
            )
            if gap > 0.5 * radius:
                return pieces, path
    return pieces, path


def _motion(
    random: np.random.Generator, scene_from_camera: Array, tip: Array, entry: Array, calm: float, *, rides: bool
) -> Array:
    """Poses of the tip's frame: pushed along its axis and swung about the entry."""
    frames = len(scene_from_camera)
    length = float(np.linalg.norm(tip - entry))
    base = frame_towards(tip - entry, entry, random.uniform(0, 2 * np.pi))
    quick = (10.0, 40.0)
    push = calm * random.uniform(0.0, 0.3) * length * _sway(random, frames, quick)
    swings = [calm * np.radians(random.uniform(0.0, 8.0)) * _sway(random, frames, quick) for _ in range(2)]
    roll = calm * np.radians(random.uniform(0.0, 20.0)) * _sway(random, frames, quick)
    path = np.empty((frames, 4, 4))
    for t in range(frames):
        anchor = scene_from_camera[t if rides else 0]
        pivot = base @ _turn(swings[0][t], 0) @ _turn(swings[1][t], 1) @ _turn(roll[t], 2)
        shift = np.eye(4)
        shift[2, 3] = length + min(push[t], 0.25 * length)
        path[t] = anchor @ pivot @ shift
    return path


def _sway(random: np.random.Generator, frames: int, periods: tuple[float, float]) -> Array:
    """A smooth signal that starts at 0 and stays within about 2."""
    time = np.arange(frames)
    phase, period = random.uniform(0, 2 * np.pi), random.uniform(*periods)
    return np.asarray(np.sin(2 * np.pi * time / period + phase) - np.sin(phase))


def _turn(angle: float, axis: int) -> Array:
    """A rotation about one axis, ``(4, 4)``."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(4)
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[second, first], turn[first, second] = np.sin(angle), -np.sin(angle)
    return turn


def _along(z: float, x: float = 0.0) -> Array:
    frame = np.eye(4)
    frame[0, 3], frame[2, 3] = x, z
    return frame


_Piece = tuple[int, Array, tuple[float, float, float], Look]


def _shape(random: np.random.Generator, radius: float, length: float) -> list[_Piece]:
    """Shaft and tip along -z from the origin: rounded, tapered, blunt, or two jaws on a joint."""
    shaft = _SHAFTS[int(random.integers(len(_SHAFTS)))]
    bright = random.uniform(0.6, 1.2)
    shaft = shaft._replace(colour=tuple(min(1.0, bright * value) for value in shaft.colour))  # type: ignore[arg-type]
    if random.uniform() < 0.2:
        marks = STRIPES if random.uniform() < 0.7 else PLAIN
        shaft = shaft._replace(pattern=marks, grain_mm=random.uniform(3.0, 9.0) * radius, other=(0.02, 0.02, 0.02))
    tip = random.choice(["round", "taper", "blunt", "jaws"], p=[0.25, 0.2, 0.1, 0.45])
    metal = shaft if random.uniform() < 0.4 else _STEEL

    def rod(end: float, at_end: float, behind: float, size: float, look: Look) -> _Piece:
        """A frustum from ``-size`` behind its end at z = ``end``: radius ``behind`` there, ``at_end`` here."""
        return FRUSTUM, _along(end - size / 2), (behind, at_end, size / 2), look

    if tip == "round":
        return [rod(-radius, radius, radius, length, shaft), (BALL, _along(-radius), (radius,) * 3, shaft)]
    if tip == "taper":
        cone, thin = random.uniform(2.0, 5.0) * radius, random.uniform(0.2, 0.5) * radius
        return [
            (BALL, _along(-thin), (thin,) * 3, metal),
            rod(-thin, thin, radius, cone, metal),
            rod(-thin - cone, radius, radius, length, shaft),
        ]
    if tip == "blunt":
        return [rod(0.0, radius, radius, length, shaft)]
    jaw, half_angle = random.uniform(3.0, 7.0) * radius, np.radians(random.uniform(1.0, 28.0))
    pieces: list[_Piece] = [
        (BALL, _along(-jaw), (0.8 * radius,) * 3, metal),
        rod(-jaw - 0.8 * radius, 0.9 * radius, 0.9 * radius, 1.5 * radius, metal),
        rod(-jaw - 2.3 * radius, radius, radius, length, shaft),
    ]
    flat = random.uniform() < 0.5
    for side in (-1.0, 1.0):
        hinge = _along(-jaw) @ _turn(side * half_angle, 1)
        if flat:
            size = (0.22 * radius, 0.55 * radius, jaw / 2)
            pieces.append((BOX, hinge @ _along(jaw / 2, side * 0.25 * radius), size, metal))
        else:
            size = (0.5 * radius, 0.2 * radius, jaw / 2)
            pieces.append((FRUSTUM, hinge @ _along(jaw / 2, side * 0.3 * radius), size, metal))
    return pieces

r"""Tissue that moves: breathing, and the travelling waves of peristalsis.

A surface is moved along its own height only: along the radius of a tube, along z of a field. The height
gains :math:`\sum_n a_n \cos(k_n \cdot p - \omega_n t + \varphi_n)` of the place p on the map, which has a closed
form, so that depth stays exact and every point can be followed to any frame.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import LifeRanges, draw
from bathyscope_train.data.synthetic.scene import FIELD, NOTHING, TUBE, Surface

Array = npt.NDArray[np.float64]


class Swell(NamedTuple):
    """How the surface of one clip moves."""

    kind: int
    """TUBE or FIELD."""
    waves: Array
    """``(n, 5)``: amplitude in mm, radians per mm along z (tube) or y (field), radians per radian round a tube (whole
    numbers) or per mm along x of a field, radians a frame, phase."""
    centre: Array
    """``(rows, 2)``: centreline of a tube at ``first + step * row``."""
    first: float
    step: float
    scene_from_world: Array
    """4x4; the world is the first camera."""


def draw_swell(random: np.random.Generator, ranges: LifeRanges, surface: Surface) -> Swell | None:
    """Breathing, peristalsis, both or, mostly, nothing."""
    breathes, squirms = random.uniform(size=2) < (ranges.breathing, ranges.peristalsis)
    if surface.kind == NOTHING or not (breathes or squirms):
        return None
    rows = len(surface.heights)
    tube = surface.kind == TUBE
    size = float(np.median(surface.heights[rows // 4 : -rows // 4])) if tube else 0.3 * rows * surface.step[0]
    waves = []
    if breathes:  # everything up and down in place: two waves that run against each other
        amplitude = draw(random, ranges.amplitude) * size
        turn, phase = 2 * np.pi / draw(random, ranges.period), random.uniform(0, 2 * np.pi)
        long = random.uniform(0.0, 1.5 / size, 2) * (1, 0 if tube else 1)
        place = random.uniform(0, 2 * np.pi)
        waves += [(amplitude / 2, *long, sign * turn, place + sign * phase) for sign in (-1.0, 1.0)]
    if squirms:
        amplitude = draw(random, ranges.amplitude) * size
        lobes = float(random.integers(0, 3)) if tube else random.uniform(-2.0, 2.0) / size
        along = random.choice([-1.0, 1.0]) * random.uniform(1.5, 4.0) / size
        waves.append((amplitude, along, lobes, 2 * np.pi / draw(random, ranges.period), random.uniform(0, 2 * np.pi)))
    return Swell(
        surface.kind,
        np.array(waves),
        np.asarray(surface.centre, np.float64),
        surface.first[0],
        surface.step[0],
        np.eye(4),
    )


def gain(swell: Swell, along: npt.NDArray[np.floating], across: npt.NDArray[np.floating], frame: float) -> Array:
    """What the heights gain at places of the map.

    Args:
        swell: The motion.
        along: z of a tube, y of a field.
        across: Angle round a tube, x of a field; broadcast against ``along``.
        frame: Time in frames; fractions are allowed.
    """
    total = np.zeros(np.broadcast_shapes(np.shape(along), np.shape(across)))
    for amplitude, k_along, k_across, turn, phase in swell.waves:
        total += amplitude * np.cos(k_along * along + k_across * across - turn * frame + phase)
    return total


def swollen(surface: Surface, swell: Swell, frame: float) -> Surface:
    """The surface in one frame."""
    rows, columns = surface.heights.shape
    along = surface.first[0] + surface.step[0] * np.arange(rows)[:, None]
    place = surface.first[1] + surface.step[1] * np.arange(columns)[None, :]
    if surface.kind == TUBE:
        quarter, rest = np.divmod(place, 1.0)
        place = quarter * np.pi / 2 + np.arctan2(rest, 1.0 - rest)
    heights = surface.heights + gain(swell, along, place, frame)
    most = float(np.abs(swell.waves[:, 0]).sum())
    return surface._replace(
        heights=np.ascontiguousarray(heights, np.float32),
        core=np.ascontiguousarray(surface.core - most, np.float32),
        waves=now(swell, frame),
    )


def now(swell: Swell, frame: float) -> Array:
    """The waves as a ``Surface`` of one frame holds them, ``(n, 4)``."""
    amplitude, along, across, turn, phase = swell.waves.T
    return np.stack([amplitude, along, across, phase - turn * frame], axis=1)


def carried(swell: Swell, points: Array, source: float, target: float) -> Array:
    """Where points of the surface, seen in frame ``source``, are in frame ``target``; ``(..., 3)``, in the world."""
    turn, shift = swell.scene_from_world[:3, :3], swell.scene_from_world[:3, 3]
    scene = np.asarray(points @ turn.T + shift, np.float64)
    moved = scene.copy()
    if swell.kind == FIELD:
        y, x = scene[..., 1], scene[..., 0]
        moved[..., 2] += gain(swell, y, x, target) - gain(swell, y, x, source)
    else:
        rows = swell.first + swell.step * np.arange(len(swell.centre))
        middle = np.stack([np.interp(scene[..., 2], rows, swell.centre[:, axis]) for axis in range(2)], axis=-1)
        out = scene[..., :2] - middle
        reach = np.linalg.norm(out, axis=-1)
        angle = np.asarray(np.arctan2(out[..., 1], out[..., 0]), np.float64)
        grown = reach + gain(swell, scene[..., 2], angle, target) - gain(swell, scene[..., 2], angle, source)
        moved[..., :2] = middle + out * (grown / np.maximum(reach, 1e-9))[..., None]
    return np.asarray((moved - shift) @ turn)

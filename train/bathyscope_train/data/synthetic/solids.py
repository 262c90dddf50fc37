"""Hard bodies in a scene: the boxes and cylinders of a room, and the parts of an instrument.

Each solid is a shape with a closed form for its intersection with a ray, so depth is exact. Solids of a
*mover* move from frame to frame; the others are part of the scene.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

BOX = 0
"""``size``: the three half edges."""
ROOM = 1
"""A box seen from inside."""
FRUSTUM = 2
"""A capped cone or cylinder about its z axis; ``size``: radius at -z, radius at +z, half length."""
BALL = 3
"""``size``: the radius, thrice."""

PLAIN, CLOUDS, WOOD, TILES, STRIPES, PRINT, COLLAGE = range(7)
"""Patterns: see ``solid_shading.pattern``."""


class Look(NamedTuple):
    """What a solid is made of. Colours are linear reflectances."""

    colour: tuple[float, float, float]
    other: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The second colour of a pattern."""
    pattern: int = PLAIN
    grain_mm: float = 1.0
    """Size of the pattern."""
    contrast: float = 1.0
    """Share of the second colour where the pattern is strongest."""
    specular: float = 0.1
    shininess: float = 20.0
    metal: float = 0.0
    """0 scatters light, 1 mirrors it in a broad lobe."""


class Solids(NamedTuple):
    """All hard bodies of a scene in one frame; any number, none included."""

    kind: npt.NDArray[np.int64]
    """``(n,)``: BOX, ROOM, FRUSTUM or BALL."""
    local_from_scene: Array
    """``(n, 3, 4)``: into the frame in which the shape sits at the origin."""
    size: Array
    """``(n, 3)``, millimetres; meaning by kind."""
    bound: Array
    """``(n, 4)``: middle and radius of a ball around each, in the scene."""
    look: Array
    """``(n, 12)``: the numbers of ``Look`` in their order."""
    mover: npt.NDArray[np.int64]
    """``(n,)``: 0 stands still in the scene, k belongs to mover k."""
    lights: Array
    """``(k, 4)``: lamps that hang in the scene: position, and their light at ``reach_mm``."""
    reach_mm: float
    sky: float
    """Light from everywhere."""
    lamp_share: float
    """How much of the endoscope's own lamp reaches the solids; 0 in a room."""


class Part(NamedTuple):
    """One solid before it is put into the table."""

    kind: int
    scene_from_local: Array
    """``(4, 4)``; of a mover's part the place in the mover's own frame."""
    size: tuple[float, float, float]
    look: Look
    mover: int = 0


def make_solids(
    parts: list[Part], *, lights: Array | None = None, reach_mm: float = 20.0, sky: float = 0.0, lamp_share: float = 1.0
) -> Solids:
    """The table of ``parts``; see ``Solids`` for the arguments."""
    count = len(parts)
    local = np.zeros((count, 3, 4))
    for index, part in enumerate(parts):
        local[index] = np.linalg.inv(part.scene_from_local)[:3]
    kinds = np.array([part.kind for part in parts], np.int64).reshape(count)
    sizes = np.array([part.size for part in parts], np.float64).reshape(count, 3)
    looks = [[*p.look.colour, *p.look.other, *(float(value) for value in p.look[2:])] for p in parts]
    return Solids(
        kind=kinds,
        local_from_scene=local,
        size=sizes,
        bound=_bounds(kinds, local, sizes),
        look=np.array(looks, np.float64).reshape(count, 12),
        mover=np.array([part.mover for part in parts], np.int64).reshape(count),
        lights=np.zeros((0, 4)) if lights is None else np.ascontiguousarray(lights, np.float64),
        reach_mm=reach_mm,
        sky=sky,
        lamp_share=lamp_share,
    )


def _bounds(kind: npt.NDArray[np.int64], local_from_scene: Array, size: Array) -> Array:
    """Middle and radius of a ball around each solid, ``(n, 4)``."""
    middle = -np.einsum("nji,nj->ni", local_from_scene[..., :3], local_from_scene[..., 3])
    rod = np.hypot(np.maximum(size[:, 0], size[:, 1]), size[:, 2])
    radius = np.select([kind == FRUSTUM, kind == BALL], [rod, size[:, 0]], np.linalg.norm(size, axis=1))
    return np.concatenate([middle, radius[:, None]], axis=1)


NO_SOLIDS = make_solids([])


def joined(still: Solids, moving: Solids) -> Solids:
    """Both tables in one, lit as ``still`` is."""
    return still._replace(
        kind=np.concatenate([still.kind, moving.kind]),
        local_from_scene=np.concatenate([still.local_from_scene, moving.local_from_scene]),
        size=np.concatenate([still.size, moving.size]),
        bound=np.concatenate([still.bound, moving.bound]),
        look=np.concatenate([still.look, moving.look]),
        mover=np.concatenate([still.mover, moving.mover]),
    )


def placed(solids: Solids, scene_from_mover: Array) -> Solids:
    """The solids of one frame.

    Args:
        solids: The table, the parts of each mover in that mover's own frame.
        scene_from_mover: ``(m, 4, 4)``, where each mover is.
    """
    local = solids.local_from_scene.copy()
    for index, mover in enumerate(solids.mover):
        if mover > 0:
            local[index] = solids.local_from_scene[index] @ np.linalg.inv(scene_from_mover[mover - 1])
    return solids._replace(local_from_scene=local, bound=_bounds(solids.kind, local, solids.size))


def frame_towards(axis: Array, origin: Array, roll: float = 0.0) -> Array:
    """A rigid frame, ``(4, 4)``, at ``origin`` whose z axis points along ``axis``."""
    forward = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    side = np.cross([0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0], forward)
    side /= np.linalg.norm(side)
    up = np.cross(forward, side)
    frame = np.eye(4)
    frame[:3, 0] = np.cos(roll) * side + np.sin(roll) * up
    frame[:3, 1] = np.cos(roll) * up - np.sin(roll) * side
    frame[:3, 2] = forward
    frame[:3, 3] = origin
    return frame

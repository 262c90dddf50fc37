"""A rendered scene: one displaced surface as a map, its colours, the solid grain of its tissue, and hard bodies.

Tissue is one of two surfaces. A *tube* has a radius map over (z, angle) around a centreline that is a
function of z; a *field* has a depth map over (y, x). Both are the zero of a function that is positive in
the free space where the camera moves, so that one kernel traces both. A room has no tissue, only solids.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.solids import NO_SOLIDS, Solids

Array = npt.NDArray[np.float32]

TUBE = 0
FIELD = 1
NOTHING = 2
BLOCK = 8
EVEN = np.ones((1, 1), np.float32)


STILL = np.zeros((0, 4))


class Surface(NamedTuple):
    """Geometry, in millimetres of the scene's own frame."""

    kind: int
    heights: Array
    """``(rows, columns)``: radius over (z, diamond angle) of a tube, depth z over (y, x) of a field, else unused."""
    centre: Array
    """``(rows, 2)``: x and y of a tube's centreline at each row; zeros for a field."""
    first: tuple[float, float]
    """Row and column coordinate of the first sample: z (and 0) of a tube, y and x of a field."""
    step: tuple[float, float]
    """Distance of two samples. Columns of a tube count quarters of a turn: 4 / columns."""
    density: tuple[float, float]
    """Samples per unit, 1 / step."""
    stride_mm: float
    """Longest step of the ray marcher near the wall: less than the thinnest fold."""
    core: Array
    """Least height within ``leap_mm`` of each block of ``BLOCK`` x ``BLOCK`` samples; of a tube's whole ring."""
    leap_mm: float
    """Longest step of the ray marcher inside the core."""
    feature_mm: float
    """Size of the creases that are darkened."""
    waves: npt.NDArray[np.float64] = STILL
    """``(n, 4)``: by what its heights differ from those of the tissue at rest, whose texture it keeps: amplitude,
    radians per unit along rows and along columns (angle or mm), phase; see ``swell``."""


class Tissue(NamedTuple):
    """Reflectance and relief."""

    albedo: Array
    """``(rows, columns, 3)``: linear colour on the surface's own grid."""
    vessels: tuple[Array, Array, Array, Array]
    """Density of vessels in [0, 1] over the whole surface map, each level half the size of the one before."""
    vessel_step_mm: float
    """Size of one sample of the first level."""
    vessel_tint: tuple[float, float, float]
    """What a vessel leaves of the colour."""
    solid: Array
    """``(n, n, n, 5)``: blotches, spots and the slope of the fine relief (3), repeating."""
    solid_step_mm: float
    mottle: float
    spots: float
    bump: float
    specular: float
    shininess: float
    gloss: Array = EVEN
    """``(rows, columns)`` on the surface's own grid: highlights against those of the rest; one number is 1."""
    coat: float = 0.0
    """Strength of the highlights of a wet film."""
    coat_shininess: float = 150.0
    coat_bump: float = 0.0
    """Slope of the film's relief, which bends and breaks its highlights."""
    dry: float = -3.0
    """Level of the blotches below which the film is gone."""
    regions: float = 0.0
    """Logarithm of the contrast of large light and dark regions."""
    region_edge: float = 1.0
    region_level: float = 0.0
    fine: float = 0.0
    """Strength of a third, finer octave of blotches and relief."""
    capillaries: float = 0.0


class Stage(NamedTuple):
    """Where a camera may stand; scenes without one are entered as their kind of surface suggests."""

    target: tuple[float, float, float]
    """What the camera looks at, more or less."""
    spread_mm: tuple[float, float, float]
    """How far the look may stray from it along each axis."""
    distance_mm: tuple[float, float]
    """From the target to the camera."""
    slant_deg: tuple[float, float]
    """Angle between ``back`` and the way to the camera."""
    margin_mm: float
    """How far the camera stays from everything."""
    back: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """From the target towards the usual place of the camera."""
    upright: bool = False
    """Whether the camera is held level, as in a room."""


class Scene(NamedTuple):
    """Everything that does not move."""

    family: str
    surface: Surface
    tissue: Tissue
    solids: Solids = NO_SOLIDS
    stage: Stage | None = None


def smooth_field(heights: npt.NDArray[np.floating], samples: float) -> Array:
    """Blur the depth map of a field, so that no step is steeper than the map resolves."""
    blurred = cv2.GaussianBlur(np.asarray(heights, np.float32), (0, 0), samples, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32)


def make_surface(
    kind: int,
    heights: npt.NDArray[np.floating],
    *,
    first: tuple[float, float],
    step: tuple[float, float],
    stride_mm: float,
    feature_mm: float,
    centre: Array | None = None,
) -> Surface:
    """A surface with the tables that its ray marcher needs; see ``Surface`` for the arguments."""
    leap_mm = 4.0 * stride_mm
    margin = int(np.ceil(leap_mm / step[0]))
    if kind == TUBE:
        least = heights.min(axis=1, keepdims=True)
        window, stride = (2 * margin + 1, 1), (BLOCK, 1)
    else:
        least, window, stride = heights, (2 * margin + 1, 2 * margin + 1), (BLOCK, BLOCK)
    least = cv2.erode(least, np.ones(window, np.uint8), borderType=cv2.BORDER_REPLICATE).reshape(least.shape)
    for axis in range(2):
        starts = np.arange(0, least.shape[axis], stride[axis])
        least = np.minimum.reduceat(least, starts, axis=axis)
    return Surface(
        kind=kind,
        heights=np.ascontiguousarray(heights, np.float32),
        centre=np.zeros((2, 2), np.float32) if centre is None else centre,
        first=first,
        step=step,
        density=(1.0 / step[0], 1.0 / step[1]),
        stride_mm=stride_mm,
        core=np.ascontiguousarray(least, np.float32),
        leap_mm=leap_mm,
        feature_mm=feature_mm,
    )

"""A rendered scene: one displaced surface as a map, its colours, and the solid grain of its tissue.

All scenes are one of two surfaces. A *tube* has a radius map over (z, angle) around a centreline that is a
function of z; a *field* has a depth map over (y, x). Both are the zero of a function that is positive in
the free space where the camera moves, so that one kernel traces both.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

TUBE = 0
FIELD = 1


class Surface(NamedTuple):
    """Geometry, in millimetres of the scene's own frame."""

    kind: int
    heights: Array
    """``(rows, columns)``: radius over (z, diamond angle) of a tube, depth z over (y, x) of a field."""
    centre: Array
    """``(rows, 2)``: x and y of a tube's centreline at each row; zeros for a field."""
    first: tuple[float, float]
    """Row and column coordinate of the first sample: z (and 0) of a tube, y and x of a field."""
    step: tuple[float, float]
    """Distance of two samples. Columns of a tube count quarters of a turn: 4 / columns."""
    stride_mm: float
    """Longest step of the ray marcher: less than the thinnest fold."""
    feature_mm: float
    """Size of the creases that are darkened."""


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


class Scene(NamedTuple):
    """Everything that does not move."""

    family: str
    surface: Surface
    tissue: Tissue

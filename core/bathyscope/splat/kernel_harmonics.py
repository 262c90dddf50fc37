"""Kernel: the colour of one Gaussian towards the camera."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from bathyscope.splat.harmonics import C0, C1, C2, C3, C4
from bathyscope.splat.jit import kernel
from bathyscope.splat.kernel_project import BLUE, CENTRE, GREEN, PROJECTED, RECORD, RED

F32 = np.float32
_C0, _C1 = F32(C0), F32(C1)
_C2 = tuple(F32(c) for c in C2)
_C3 = tuple(F32(c) for c in C3)
_C4 = tuple(F32(c) for c in C4)
_HALF, _TWO, _THREE, _FOUR, _SEVEN, _ONE = F32(0.5), F32(2), F32(3), F32(4), F32(7), F32(1)
_TINY = F32(1e-30)


@kernel
def fill_basis(x: Any, y: Any, z: Any, degree: int, basis: Any) -> None:
    """The functions of ``harmonics.harmonic_terms`` for one direction, into ``basis`` (25,)."""
    basis[0] = _C0
    if degree >= 1:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        basis[4], basis[5], basis[7] = _C2[0] * x * y, _C2[1] * y * z, _C2[3] * x * z
        basis[6], basis[8] = _C2[2] * (_TWO * zz - xx - yy), _C2[4] * (xx - yy)
    if degree >= 3:
        basis[9] = _C3[0] * y * (_THREE * xx - yy)
        basis[10] = _C3[1] * x * y * z
        basis[11] = _C3[2] * y * (_FOUR * zz - xx - yy)
        basis[12] = _C3[3] * z * (_TWO * zz - _THREE * xx - _THREE * yy)
        basis[13] = _C3[4] * x * (_FOUR * zz - xx - yy)
        basis[14] = _C3[5] * z * (xx - yy)
        basis[15] = _C3[6] * x * (xx - _THREE * yy)
    if degree >= 4:
        basis[16] = _C4[0] * x * y * (xx - yy)
        basis[17] = _C4[1] * y * z * (_THREE * xx - yy)
        basis[18] = _C4[2] * x * y * (_SEVEN * zz - _ONE)
        basis[19] = _C4[3] * y * z * (_SEVEN * zz - _THREE)
        basis[20] = _C4[4] * (zz * (F32(35) * zz - F32(30)) + _THREE)
        basis[21] = _C4[5] * x * z * (_SEVEN * zz - _THREE)
        basis[22] = _C4[6] * (xx - yy) * (_SEVEN * zz - _ONE)
        basis[23] = _C4[7] * x * z * (xx - _THREE * yy)
        basis[24] = _C4[8] * (xx * (xx - _THREE * yy) - yy * (_THREE * xx - yy))


@kernel
def colour(harmonics: Any, gaussian: Any, degree: int, camera: Any, source: Any, at: Any, basis: Any, out: Any) -> None:
    """Colour of ``gaussian``, number ``at`` of a chunk (see ``project_eight``), into its place in ``out``."""
    mean, place = (at >> 3) * (RECORD * 8) + (at & 7), (at >> 3) * (PROJECTED * 8) + (at & 7)
    x = source[mean + 0] - camera[CENTRE]
    y = source[mean + 8] - camera[CENTRE + 1]
    z = source[mean + 16] - camera[CENTRE + 2]
    length: Any = max(sqrt(x * x + y * y + z * z), _TINY)
    inverse = _ONE / length
    fill_basis(x * inverse, y * inverse, z * inverse, degree, basis)
    red, green, blue = _HALF, _HALF, _HALF
    for k in range((degree + 1) * (degree + 1)):
        red += basis[k] * harmonics[gaussian, k, 0]
        green += basis[k] * harmonics[gaussian, k, 1]
        blue += basis[k] * harmonics[gaussian, k, 2]
    # Written so that NaN stays NaN, for the check of the finished image.
    zero = F32(0)
    out[place + RED * 8] = zero if red < zero else red
    out[place + GREEN * 8] = zero if green < zero else green
    out[place + BLUE * 8] = zero if blue < zero else blue

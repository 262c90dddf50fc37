"""Kernel: from the gradient of one Gaussian's colour to its harmonics and its mean."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from bathyscope.splat.harmonics import C1, C2, C3, C4
from bathyscope.splat.jit import kernel
from bathyscope.splat.kernel_harmonics import fill_basis
from bathyscope.splat.kernel_project import CENTRE, PROJECTED, RECORD, RED
from bathyscope.splat.kernel_project_backward import BY_COLOUR, FROM_COLOUR, SUMS

F32 = np.float32
_C1 = F32(C1)
_C2 = tuple(F32(c) for c in C2)
_C3 = tuple(F32(c) for c in C3)
_C4 = tuple(F32(c) for c in C4)
_TWO, _THREE, _FOUR, _SIX, _SEVEN, _EIGHT = F32(2), F32(3), F32(4), F32(6), F32(7), F32(8)
_FOURTEEN, _ONE, _ZERO = F32(14), F32(1), F32(0)
_TINY = F32(1e-30)


@kernel
def colour_backward(
    harmonics: Any,
    gaussian: Any,
    degree: int,
    camera: Any,
    source: Any,
    at: Any,
    item: Any,
    sums: Any,
    basis: Any,
    by_harmonics: Any,
) -> None:
    """Gradients through the colour of ``gaussian``, number ``at`` of a chunk.

    The gradient of the colour is read from ``sums`` (CHUNK, SUMS) and that of the mean written into it; gradients of
    the harmonics are added to ``by_harmonics`` (n, k, 3). A colour that is bounded at 0 passes nothing.
    """
    got, seen, mean = at * SUMS, (at >> 3) * (PROJECTED * 8) + (at & 7), (at >> 3) * (RECORD * 8) + (at & 7)
    red = sums[got + BY_COLOUR] if item[seen + RED * 8] > _ZERO else _ZERO
    green = sums[got + BY_COLOUR + 1] if item[seen + (RED + 1) * 8] > _ZERO else _ZERO
    blue = sums[got + BY_COLOUR + 2] if item[seen + (RED + 2) * 8] > _ZERO else _ZERO
    x = source[mean + 0] - camera[CENTRE]
    y = source[mean + 8] - camera[CENTRE + 1]
    z = source[mean + 16] - camera[CENTRE + 2]
    length: Any = max(sqrt(x * x + y * y + z * z), _TINY)
    inverse = _ONE / length
    x, y, z = x * inverse, y * inverse, z * inverse
    fill_basis(x, y, z, degree, basis)
    for k in range((degree + 1) * (degree + 1)):
        value = basis[k]
        # What the basis function itself gets takes its place.
        basis[k] = (
            red * harmonics[gaussian, k, 0] + green * harmonics[gaussian, k, 1] + blue * harmonics[gaussian, k, 2]
        )
        by_harmonics[gaussian, k, 0] += red * value
        by_harmonics[gaussian, k, 1] += green * value
        by_harmonics[gaussian, k, 2] += blue * value
    across, down, ahead = _slope(x, y, z, degree, basis)
    # The direction has unit length: what points along it changes nothing.
    along = across * x + down * y + ahead * z
    sums[got + FROM_COLOUR] = (across - along * x) * inverse
    sums[got + FROM_COLOUR + 1] = (down - along * y) * inverse
    sums[got + FROM_COLOUR + 2] = (ahead - along * z) * inverse


@kernel
def _slope(x: Any, y: Any, z: Any, degree: int, g: Any) -> Any:
    """Gradient by (x, y, z) of the sum of ``g`` times the functions of ``harmonics.harmonic_terms``."""
    dx, dy, dz = _ZERO, _ZERO, _ZERO
    if degree >= 1:
        dx, dy, dz = -_C1 * g[3], -_C1 * g[1], _C1 * g[2]
    if degree >= 2:
        g4, g5, g6, g7, g8 = _C2[0] * g[4], _C2[1] * g[5], _C2[2] * g[6], _C2[3] * g[7], _C2[4] * g[8]
        dx += g4 * y - _TWO * g6 * x + g7 * z + _TWO * g8 * x
        dy += g4 * x + g5 * z - _TWO * g6 * y - _TWO * g8 * y
        dz += g5 * y + _FOUR * g6 * z + g7 * x
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    if degree >= 3:
        g9, g10, g11, g12 = _C3[0] * g[9], _C3[1] * g[10], _C3[2] * g[11], _C3[3] * g[12]
        g13, g14, g15 = _C3[4] * g[13], _C3[5] * g[14], _C3[6] * g[15]
        dx += _SIX * g9 * xy + g10 * yz - _TWO * g11 * xy - _SIX * g12 * xz
        dx += g13 * (_FOUR * zz - _THREE * xx - yy) + _TWO * g14 * xz + _THREE * g15 * (xx - yy)
        dy += _THREE * g9 * (xx - yy) + g10 * xz + g11 * (_FOUR * zz - xx - _THREE * yy) - _SIX * g12 * yz
        dy += -_TWO * g13 * xy - _TWO * g14 * yz - _SIX * g15 * xy
        dz += g10 * xy + _EIGHT * g11 * yz + g12 * (_SIX * zz - _THREE * xx - _THREE * yy) + _EIGHT * g13 * xz
        dz += g14 * (xx - yy)
    if degree >= 4:
        g16, g17, g18, g19, g20 = _C4[0] * g[16], _C4[1] * g[17], _C4[2] * g[18], _C4[3] * g[19], _C4[4] * g[20]
        g21, g22, g23, g24 = _C4[5] * g[21], _C4[6] * g[22], _C4[7] * g[23], _C4[8] * g[24]
        seven = _SEVEN * zz - _ONE
        dx += g16 * y * (_THREE * xx - yy) + _SIX * g17 * xy * z + g18 * y * seven
        dx += g21 * z * (_SEVEN * zz - _THREE) + _TWO * g22 * x * seven + _THREE * g23 * z * (xx - yy)
        dx += _FOUR * g24 * x * (xx - _THREE * yy)
        dy += g16 * x * (xx - _THREE * yy) + _THREE * g17 * z * (xx - yy) + g18 * x * seven
        dy += g19 * z * (_SEVEN * zz - _THREE) - _TWO * g22 * y * seven - _SIX * g23 * xy * z
        dy += _FOUR * g24 * y * (yy - _THREE * xx)
        dz += g17 * y * (_THREE * xx - yy) + _FOURTEEN * g18 * xy * z + g19 * y * (F32(21) * zz - _THREE)
        dz += g20 * z * (F32(140) * zz - F32(60)) + g21 * x * (F32(21) * zz - _THREE)
        dz += _FOURTEEN * g22 * z * (xx - yy) + g23 * x * (xx - _THREE * yy)
    return dx, dy, dz

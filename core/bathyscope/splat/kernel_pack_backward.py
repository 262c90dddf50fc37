"""Kernel: from gradients of a scene's records to those of its Gaussians."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from bathyscope.splat.jit import kernel
from bathyscope.splat.kernel_project import AXES, LOG_OPACITY, MEAN


@kernel
def pack_backward(
    rotations: Any,
    scales: Any,
    opacities: Any,
    records: Any,
    by_means: Any,
    by_rotations: Any,
    by_scales: Any,
    by_opacities: Any,
) -> None:
    """The other direction of ``kernel_pack.pack``.

    Args:
        rotations: (n, 4) of any length.
        scales: (n, 3).
        opacities: (n,).
        records: (n, RECORD) gradients, with dL/d ln(opacity) for the opacity.
        by_means: (n, 3) out.
        by_rotations: (n, 4) out, of the quaternions as they are.
        by_scales: (n, 3) out.
        by_opacities: (n,) out; 0 for an opacity of 0, which no pixel sees.
    """
    two, one, zero = np.float32(2), np.float32(1), np.float32(0)
    for i in range(len(opacities)):
        record, scale = records[i], scales[i]
        w, x, y, z = rotations[i, 0], rotations[i, 1], rotations[i, 2], rotations[i, 3]
        shrink = np.float32(1.0 / sqrt(float(w) * w + float(x) * x + float(y) * y + float(z) * z))
        w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
        g00, g01, g02 = record[AXES], record[AXES + 1], record[AXES + 2]
        g10, g11, g12 = record[AXES + 3], record[AXES + 4], record[AXES + 5]
        g20, g21, g22 = record[AXES + 6], record[AXES + 7], record[AXES + 8]
        by_scales[i, 0] = (
            (one - two * (y * y + z * z)) * g00 + two * (x * y + w * z) * g10 + two * (x * z - w * y) * g20
        )
        by_scales[i, 1] = (
            two * (x * y - w * z) * g01 + (one - two * (x * x + z * z)) * g11 + two * (y * z + w * x) * g21
        )
        by_scales[i, 2] = (
            two * (x * z + w * y) * g02 + two * (y * z - w * x) * g12 + (one - two * (x * x + y * y)) * g22
        )
        a, b, c = two * scale[0], two * scale[1], two * scale[2]
        g00, g10, g20 = a * g00, a * g10, a * g20
        g01, g11, g21 = b * g01, b * g11, b * g21
        g02, g12, g22 = c * g02, c * g12, c * g22
        by_w = x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01)
        by_x = y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - two * x * (g11 + g22)
        by_y = x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - two * y * (g00 + g22)
        by_z = x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - two * z * (g00 + g11)
        along = w * by_w + x * by_x + y * by_y + z * by_z
        by_rotations[i, 0], by_rotations[i, 1] = (by_w - along * w) * shrink, (by_x - along * x) * shrink
        by_rotations[i, 2], by_rotations[i, 3] = (by_y - along * y) * shrink, (by_z - along * z) * shrink
        by_opacities[i] = record[LOG_OPACITY] / opacities[i] if opacities[i] > zero else zero
        for axis in range(3):
            by_means[i, axis] = record[MEAN + axis]

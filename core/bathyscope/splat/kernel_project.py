"""Kernel: Gaussians into a camera, eight at a time, by the formulas of ``plain_projection``.

The covariance leaves as its Cholesky factor: with p = l0 dx + l1 dy and q = l2 dy, a pixel's alpha is
2^(log2(opacity) - p^2 - q^2). There are only squares to add, so thin Gaussians lose nothing to cancellation.
"""

from __future__ import annotations

from math import log, log2, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.splat import lanes
from bathyscope.splat.jit import inlined
from bathyscope.splat.lanes import at_least, at_most, load, madd, pick, root, store, store_truncated, wide
from bathyscope.splat.plain_projection import REACH_CAP
from bathyscope.splat.settings import SplatSettings
from bathyscope.splat.view import View

CHUNK = 2048
"""Gaussians worked on together; a multiple of eight."""

# Rows of a record: mean (3), axes row by row (9), log2 of the opacity; three unused, it fills a cache line.
MEAN, AXES, LOG_OPACITY, RECORD = 0, 3, 12, 16
# Rows of a projected Gaussian; the first three are those of the colour, once it is asked for.
RED, GREEN, BLUE, U, V, DEPTH, L0, L1, L2, EXPONENT, RADIUS_U, RADIUS_V, COMPENSATION, PROJECTED = range(14)
# Rows of its box in whole pixels, both ends included; empty if the first exceeds the last.
LEFT, RIGHT, TOP, BOTTOM, BOX = range(5)

# Where the numbers of a camera are.
ROTATION, TRANSLATION, FOCAL, PRINCIPAL, LOWER, UPPER, SIZE = 0, 9, 12, 14, 16, 18, 20
NEAR, FAR, EPS, LOG_THRESHOLD, CLIP, CUTOFF, MAX_ALPHA, TILT, CENTRE, CAMERA = 22, 23, 24, 25, 26, 27, 28, 29, 31, 34

F32 = np.float32
ONE, ZERO = F32(1.0), F32(0.0)
TWO_LN2 = F32(2 * log(2.0))
_SHARPNESS = F32(sqrt(0.5 / log(2.0)))
_CAP = F32(REACH_CAP)
# Pixel centres are at +0.5; a hundredth more than the ellipse, for rounding.
_BEFORE, _AFTER = F32(0.51), F32(0.49)
_LARGEST_RADIUS = F32(2.0**30)


def camera_numbers(view: View, settings: SplatSettings) -> NDArray[np.float32]:
    """Camera and settings as the kernels read them."""
    height, width = view.size
    numbers = np.zeros(CAMERA, np.float32)
    numbers[ROTATION:TRANSLATION] = view.rotation.ravel()
    numbers[TRANSLATION:FOCAL] = view.translation
    numbers[FOCAL:PRINCIPAL] = view.focal
    numbers[PRINCIPAL:LOWER] = view.principal
    numbers[LOWER:UPPER] = view.lower
    numbers[UPPER:SIZE] = view.upper
    numbers[SIZE:NEAR] = width, height
    numbers[NEAR], numbers[FAR], numbers[EPS] = settings.near_plane, settings.far_plane, settings.eps2d
    numbers[LOG_THRESHOLD], numbers[CLIP] = log2(settings.alpha_threshold), settings.radius_clip
    numbers[CUTOFF], numbers[MAX_ALPHA] = settings.transmittance_cutoff, settings.max_alpha
    numbers[TILT:CENTRE] = np.sqrt(1 + np.maximum(np.abs(view.lower), np.abs(view.upper)) ** 2)
    numbers[CENTRE:CAMERA] = view.centre
    return numbers


@inlined
def along(camera: Any, row: int, x: Any, y: Any, z: Any) -> Any:
    """Coordinate ``row`` in the camera of world points (x, y, z)."""
    r = ROTATION + 3 * row
    rotated = madd(x, wide(camera[r]), madd(y, wide(camera[r + 1]), z * camera[r + 2]))
    return rotated + camera[TRANSLATION + row]


@inlined
def _step(camera: Any, k: int, row: int, scale: Any, slope: Any) -> Any:
    """How pixel coordinate ``row`` moves with a step along axis ``k`` of the world."""
    return scale * (wide(camera[ROTATION + 3 * row + k]) - slope * camera[ROTATION + 6 + k])


@inlined
def _span(source: Any, at: int, axis: int, steps: Any) -> Any:
    """How a pixel coordinate moves along one axis of the Gaussians."""
    first = AXES + axis
    a, b, c = (
        load(source, at * RECORD + first * 8),
        load(source, at * RECORD + (first + 3) * 8),
        load(source, at * RECORD + (first + 6) * 8),
    )
    return madd(a, steps[0], madd(b, steps[1], c * steps[2]))


@inlined
def _store_range(boxes: Any, row: int, at: int, centre: Any, reach: Any, side: Any, visible: Any) -> None:
    """Whole pixels whose centres lie within ``reach``, in ``row`` and the row after; 1 to 0 if not visible."""
    first = at_most(at_least(lanes.ceil(centre - reach - _BEFORE), wide(ZERO)), wide(side))
    last = at_most(at_least(lanes.floor(centre + reach - _AFTER), wide(-ONE)), wide(side - ONE))
    store_truncated(boxes, at * BOX + row * 8, pick(visible, first, wide(ONE)))
    store_truncated(boxes, at * BOX + (row + 1) * 8, pick(visible, last, wide(ZERO)))


@inlined
def project_eight(source: Any, at: int, camera: Any, antialiased: bool, out: Any, boxes: Any) -> None:
    """Project the eight Gaussians from number ``at`` on.

    Args:
        source: (CHUNK / 8, RECORD, 8) records.
        at: A multiple of eight.
        camera: From ``camera_numbers``.
        antialiased: Whether opacities are compensated.
        out: (CHUNK / 8, PROJECTED, 8).
        boxes: (CHUNK / 8, BOX, 8) int32.
    """
    start = at * RECORD
    x, y, z = load(source, start), load(source, start + 8), load(source, start + 16)
    depth = along(camera, 2, x, y, z)
    slope_u, slope_v = along(camera, 0, x, y, z) / depth, along(camera, 1, x, y, z) / depth
    fu, fv = camera[FOCAL], camera[FOCAL + 1]
    u, v = madd(slope_u, wide(fu), wide(camera[PRINCIPAL])), madd(slope_v, wide(fv), wide(camera[PRINCIPAL + 1]))
    slope_u = at_most(at_least(slope_u, wide(camera[LOWER])), wide(camera[UPPER]))
    slope_v = at_most(at_least(slope_v, wide(camera[LOWER + 1])), wide(camera[UPPER + 1]))

    # Close to the camera footprints are huge: in a unit that shrinks with the depth their determinant is finite.
    unit = at_most(depth / fu, wide(ONE))
    scale_u, scale_v = unit * fu / depth, unit * fv / depth
    steps_u = (
        _step(camera, 0, 0, scale_u, slope_u),
        _step(camera, 1, 0, scale_u, slope_u),
        _step(camera, 2, 0, scale_u, slope_u),
    )
    steps_v = (
        _step(camera, 0, 1, scale_v, slope_v),
        _step(camera, 1, 1, scale_v, slope_v),
        _step(camera, 2, 1, scale_v, slope_v),
    )
    a0, a1, a2 = _span(source, at, 0, steps_u), _span(source, at, 1, steps_u), _span(source, at, 2, steps_u)
    b0, b1, b2 = _span(source, at, 0, steps_v), _span(source, at, 1, steps_v), _span(source, at, 2, steps_v)
    eps = unit * unit * camera[EPS]
    variance_u = madd(a0, a0, madd(a1, a1, madd(a2, a2, eps)))
    variance_v = madd(b0, b0, madd(b1, b1, madd(b2, b2, eps)))
    covariance = madd(a0, b0, madd(a1, b1, a2 * b2))
    m0, m1, m2 = a0 * b1 - a1 * b0, a0 * b2 - a2 * b0, a1 * b2 - a2 * b1
    before = madd(m0, m0, madd(m1, m1, m2 * m2))
    determinant = madd(eps, variance_u + variance_v - eps, before)

    exponent, compensation = load(source, start + LOG_OPACITY * 8), wide(ONE)
    if antialiased:
        compensation = root(before / determinant)
        exponent = exponent + lanes.log2(compensation)

    sigmas = root(at_least((exponent - camera[LOG_THRESHOLD]) * TWO_LN2, wide(ZERO)))
    root_u, root_v, root_d = root(variance_u), root(variance_v), root(determinant)
    capped = at_most(sigmas, wide(_CAP))
    radius_u, radius_v = lanes.ceil(capped * root_u / unit), lanes.ceil(capped * root_v / unit)
    width, height = camera[SIZE], camera[SIZE + 1]
    visible = (depth >= camera[NEAR]) & (depth <= camera[FAR]) & (determinant > ZERO)
    visible = visible & (exponent >= camera[LOG_THRESHOLD]) & (at_least(radius_u, radius_v) > camera[CLIP])
    visible = visible & (u + radius_u > ZERO) & (u - radius_u < width)
    visible = visible & (v + radius_v > ZERO) & (v - radius_v < height)

    sharpness = unit * _SHARPNESS
    store(out, at * PROJECTED + U * 8, u)
    store(out, at * PROJECTED + V * 8, v)
    store(out, at * PROJECTED + DEPTH * 8, depth)
    store(out, at * PROJECTED + L0 * 8, sharpness * root_v / root_d)
    store(out, at * PROJECTED + L1 * 8, wide(ZERO) - sharpness * covariance / (root_v * root_d))
    store(out, at * PROJECTED + L2 * 8, sharpness / root_v)
    store(out, at * PROJECTED + EXPONENT * 8, exponent)
    store(out, at * PROJECTED + COMPENSATION * 8, compensation)
    store(out, at * PROJECTED + RADIUS_U * 8, pick(visible, at_most(radius_u, wide(_LARGEST_RADIUS)), wide(ZERO)))
    store(out, at * PROJECTED + RADIUS_V * 8, pick(visible, at_most(radius_v, wide(_LARGEST_RADIUS)), wide(ZERO)))
    _store_range(boxes, LEFT, at, u, sigmas * root_u / unit, width, visible)
    _store_range(boxes, TOP, at, v, sigmas * root_v / unit, height, visible)

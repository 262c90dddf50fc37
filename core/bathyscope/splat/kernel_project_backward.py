"""Kernel: from what pixels ask of projected Gaussians to gradients of their records and of the camera.

The other direction of ``kernel_project``. Footprints stay factored: with F the rows (l0, l1) and (0, l2) and P the sums
of h times the products of p and q, the gradient of the covariance is 2 ln(2)^2 F^T P F, so that thin Gaussians lose
nothing to cancellation here either.
"""

from __future__ import annotations

from math import log
from typing import Any

import numpy as np

from bathyscope.splat.jit import inlined
from bathyscope.splat.kernel_project import (
    AXES,
    CENTRE,
    FOCAL,
    L0,
    L1,
    L2,
    LOG_OPACITY,
    LOWER,
    ONE,
    PRINCIPAL,
    PROJECTED,
    RECORD,
    ROTATION,
    TRANSLATION,
    UPPER,
    ZERO,
    along,
)
from bathyscope.splat.lanes import at_least, at_most, load, madd, peek, pick, store, wide

# What the Gaussians of a chunk get from their pixels; FROM_COLOUR (3) is the gradient of the mean through the colour.
H, HP, HQ, HPP, HPQ, HQQ, BY_DEPTH, BY_COLOUR, FROM_COLOUR, TOUCHED, SUMS = 0, 1, 2, 3, 4, 5, 6, 7, 10, 13, 16

_LN2 = np.float32(log(2.0))
_TWO = np.float32(2)
_TINY = np.float32(1e-37)


@inlined
def _axis(source: Any, at: int, axis: int) -> Any:
    """One axis of the Gaussians, its three coordinates in the world."""
    first = at * RECORD + (AXES + axis) * 8
    return load(source, first), load(source, first + 24), load(source, first + 48)


@inlined
def _dot(a: Any, b: Any) -> Any:
    return madd(a[0], b[0], madd(a[1], b[1], a[2] * b[2]))


@inlined
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def _add(sums: Any, row: int, value: Any, counts: Any) -> None:
    """Add to a row of the camera's gradient, from the Gaussians that were seen."""
    store(sums, row * 8, load(sums, row * 8) + pick(counts, value, wide(ZERO)))


@inlined
def _steps(camera: Any, row: int, scale: Any, slope: Any) -> Any:
    """How pixel coordinate ``row`` moves with a step in the world."""
    r = ROTATION + 3 * row
    return (
        scale * (wide(peek(camera, r)) - slope * peek(camera, ROTATION + 6)),
        scale * (wide(peek(camera, r + 1)) - slope * peek(camera, ROTATION + 7)),
        scale * (wide(peek(camera, r + 2)) - slope * peek(camera, ROTATION + 8)),
    )


@inlined
def _coordinate_backward(
    camera: Any, row: int, ray: Any, slope: Any, inverse: Any, by_centre: Any, by_steps: Any, sums: Any, counts: Any
) -> Any:
    """Gradients through one pixel coordinate, u or v.

    Args:
        camera: From ``camera_numbers``.
        row: 0 for u, 1 for v.
        ray: Slope of the centre, x/z or y/z.
        slope: The same, clamped.
        inverse: 1 / depth.
        by_centre: Gradient of the coordinate of the centre.
        by_steps: Gradients of ``_steps``.
        sums: (CAMERA, 8) added to.
        counts: Mask of the Gaussians that were seen.

    Returns:
        Gradients of the camera's x or y, and of its z.
    """
    focal = wide(peek(camera, FOCAL + row))
    scale = focal * inverse
    steps = _steps(camera, row, wide(ONE), slope)
    forward = wide(peek(camera, ROTATION + 6)), wide(peek(camera, ROTATION + 7)), wide(peek(camera, ROTATION + 8))
    by_scale = _dot(by_steps, steps)
    by_slope = wide(ZERO) - scale * _dot(by_steps, forward)
    for k in range(3):
        turned = scale * by_steps[k]
        _add(sums, ROTATION + 3 * row + k, turned, counts)
        _add(sums, ROTATION + 6 + k, wide(ZERO) - slope * turned, counts)
    low, high = wide(peek(camera, LOWER + row)), wide(peek(camera, UPPER + row))
    below, above = ray < low, ray > high
    _add(sums, LOWER + row, pick(below, by_slope, wide(ZERO)), counts)
    _add(sums, UPPER + row, pick(above, by_slope, wide(ZERO)), counts)
    by_ray = pick(below, wide(ZERO), pick(above, wide(ZERO), by_slope))
    by_ray = madd(focal, by_centre, by_ray)
    _add(sums, FOCAL + row, madd(by_scale, inverse, ray * by_centre), counts)
    _add(sums, PRINCIPAL + row, by_centre, counts)
    across = by_ray * inverse
    return across, wide(ZERO) - madd(by_scale * scale, inverse, across * ray)


@inlined
def project_eight_backward(
    source: Any, item: Any, by_row: Any, at: int, camera: Any, antialiased: bool, out: Any, sums: Any
) -> None:
    """Gradients of the records of the eight Gaussians from number ``at`` on, and of the camera that sees them.

    Args:
        source: (CHUNK / 8, RECORD, 8) records.
        item: (CHUNK / 8, PROJECTED, 8) from ``project_eight``.
        by_row: (CHUNK / 8, SUMS, 8) what the Gaussians get from their pixels.
        at: A multiple of eight.
        camera: From ``camera_numbers``.
        antialiased: Whether opacities are compensated.
        out: (CHUNK / 8, RECORD, 8) gradients of the records, with dL/d ln(opacity) for the opacity; where nothing was
            touched the numbers mean nothing.
        sums: (CAMERA, 8) gradients of the camera's numbers, added to.
    """
    start, got, seen = at * RECORD, at * SUMS, at * PROJECTED
    x, y, z = load(source, start), load(source, start + 8), load(source, start + 16)
    depth = along(camera, 2, x, y, z)
    inverse = wide(ONE) / depth
    ray_u, ray_v = along(camera, 0, x, y, z) * inverse, along(camera, 1, x, y, z) * inverse
    slope_u = at_most(at_least(ray_u, wide(peek(camera, LOWER))), wide(peek(camera, UPPER)))
    slope_v = at_most(at_least(ray_v, wide(peek(camera, LOWER + 1))), wide(peek(camera, UPPER + 1)))
    steps_u = _steps(camera, 0, inverse * peek(camera, FOCAL), slope_u)
    steps_v = _steps(camera, 1, inverse * peek(camera, FOCAL + 1), slope_v)
    axis_0, axis_1, axis_2 = _axis(source, at, 0), _axis(source, at, 1), _axis(source, at, 2)
    a = _dot(axis_0, steps_u), _dot(axis_1, steps_u), _dot(axis_2, steps_u)
    b = _dot(axis_0, steps_v), _dot(axis_1, steps_v), _dot(axis_2, steps_v)

    # Gradient of the covariance: two variances and twice the one between them.
    counts = load(by_row, got + TOUCHED * 8) > ZERO
    total = load(by_row, got + H * 8)
    twice = _TWO * _LN2 * _LN2
    pp, pq, qq = (
        load(by_row, got + HPP * 8) * twice,
        load(by_row, got + HPQ * 8) * twice,
        load(by_row, got + HQQ * 8) * twice,
    )
    if antialiased:
        pp, qq = pp - total * _LN2, qq - total * _LN2
    l0, l1, l2 = load(item, seen + L0 * 8), load(item, seen + L1 * 8), load(item, seen + L2 * 8)
    mixed = madd(pp, l1, pq * l2)
    uu, uv = l0 * l0 * pp, l0 * mixed
    vv = madd(l1, mixed, l2 * madd(pq, l1, qq * l2))
    uu, uv, vv = uu + uu, uv + uv, vv + vv
    by_a = madd(uu, a[0], uv * b[0]), madd(uu, a[1], uv * b[1]), madd(uu, a[2], uv * b[2])
    by_b = madd(uv, a[0], vv * b[0]), madd(uv, a[1], vv * b[1]), madd(uv, a[2], vv * b[2])
    if antialiased:
        # Where the footprint before dilation has no area there is no opacity left to change.
        area = _cross(a, b)
        unit = at_most(depth / peek(camera, FOCAL), wide(ONE))
        small = area[0] * unit * unit, area[1] * unit * unit, area[2] * unit * unit
        share = total / at_least(_dot(small, small), wide(_TINY)) * unit * unit
        more_a, more_b = _cross(b, small), _cross(small, a)
        by_a = madd(share, more_a[0], by_a[0]), madd(share, more_a[1], by_a[1]), madd(share, more_a[2], by_a[2])
        by_b = madd(share, more_b[0], by_b[0]), madd(share, more_b[1], by_b[1]), madd(share, more_b[2], by_b[2])

    by_steps_u = _back(by_a, axis_0, axis_1, axis_2)
    by_steps_v = _back(by_b, axis_0, axis_1, axis_2)
    for k in range(3):
        for axis in range(3):
            store(out, start + (AXES + 3 * k + axis) * 8, madd(by_a[axis], steps_u[k], by_b[axis] * steps_v[k]))
    store(out, start + LOG_OPACITY * 8, total)

    hp, hq = load(by_row, got + HP * 8) * (_TWO * _LN2), load(by_row, got + HQ * 8) * (_TWO * _LN2)
    by_u, by_v = l0 * hp, madd(l1, hp, l2 * hq)
    by_x, more = _coordinate_backward(camera, 0, ray_u, slope_u, inverse, by_u, by_steps_u, sums, counts)
    by_y, by_z = _coordinate_backward(camera, 1, ray_v, slope_v, inverse, by_v, by_steps_v, sums, counts)
    by_z = by_z + more + load(by_row, got + BY_DEPTH * 8)
    by_point, point = (by_x, by_y, by_z), (x, y, z)
    for row in range(3):
        _add(sums, TRANSLATION + row, by_point[row], counts)
        for k in range(3):
            _add(sums, ROTATION + 3 * row + k, by_point[row] * point[k], counts)
    for k in range(3):
        r0, r1, r2 = peek(camera, ROTATION + k), peek(camera, ROTATION + 3 + k), peek(camera, ROTATION + 6 + k)
        from_colour = load(by_row, got + (FROM_COLOUR + k) * 8)
        store(out, start + k * 8, by_x * r0 + by_y * r1 + by_z * r2 + from_colour)
        _add(sums, CENTRE + k, wide(ZERO) - from_colour, counts)


@inlined
def _back(gradient: Any, axis_0: Any, axis_1: Any, axis_2: Any) -> Any:
    """From gradients along the axes of the Gaussians to the world."""
    return (
        madd(gradient[0], axis_0[0], madd(gradient[1], axis_1[0], gradient[2] * axis_2[0])),
        madd(gradient[0], axis_0[1], madd(gradient[1], axis_1[1], gradient[2] * axis_2[1])),
        madd(gradient[0], axis_0[2], madd(gradient[1], axis_1[2], gradient[2] * axis_2[2])),
    )

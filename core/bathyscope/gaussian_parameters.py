"""Raw channels of a network's Gaussian head to the parameters of Gaussians, in numpy.

The channels are ``[opacity | 3 scale | 4 rotation | 3 x (L+1)^2 colour | fusion confidence]``. A bundle names one of
two meanings:

``anysplat``
    scale is 0.001 softplus(raw), at most 0.3 world units; the rotation (x, y, z, w) and the harmonics are given in
    the axes of the network's world.
``footprint``
    scale is softplus(raw), at most 8, times the size of the pixel at its depth, z / f; the rotation, added to the
    unit quaternion (w, x, y, z), and the harmonics are given in the camera's axes; the constant colour is that of
    the pixel plus the raw value.
"""

from __future__ import annotations

from math import isqrt

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, matrix_to_quaternion
from bathyscope.gaussians import Gaussians
from bathyscope.splat.harmonics import C0, harmonic_terms

F32 = NDArray[np.float32]
LARGEST_FOOTPRINT = 8.0
"""Largest standard deviation of a ``footprint`` Gaussian, in pixels."""


def anysplat_gaussians(means: F64, raw: F32, *, opacity_exponent: float = 0.0) -> Gaussians:
    """Gaussians of the published AnySplat head, in the world of its cameras.

    Args:
        means: (n, 3) centres.
        raw: (n, g) channels without the fusion confidence.
        opacity_exponent: x of its opacity mapping.
    """
    quaternions = raw[:, 4:8] / (np.linalg.norm(raw[:, 4:8], axis=1, keepdims=True) + 1e-8)
    return Gaussians(
        means=means.astype(np.float32),
        rotations=_with_direction(quaternions[:, [3, 0, 1, 2]]),
        scales=np.minimum(0.001 * softplus(raw[:, 1:4]), 0.3),
        opacities=map_opacity(sigmoid(raw[:, 0]), opacity_exponent),
        harmonics=_colour(raw),
    )


def footprint_gaussians(means: F64, raw: F32, *, footprint: F32, colours: F32, rotation: F64) -> Gaussians:
    """Gaussians of one camera, measured in its pixels.

    Args:
        means: (n, 3) centres, world.
        raw: (n, g) channels without the fusion confidence.
        footprint: (n,) size of the pixel at its depth, z / f.
        colours: (n, 3) RGB of the pixel in [0, 1].
        rotation: (3, 3) from the camera to the world.
    """
    local = raw[:, 4:8] + np.array([1, 0, 0, 0], np.float32)
    local = local / np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1e-12)
    harmonics = rotate_harmonics(_colour(raw), rotation)
    harmonics[:, 0] += (colours - 0.5) / C0
    return Gaussians(
        means=means.astype(np.float32),
        rotations=_with_direction(multiply_quaternions(matrix_to_quaternion(rotation), local)),
        scales=footprint[:, None] * np.minimum(softplus(raw[:, 1:4]), LARGEST_FOOTPRINT),
        opacities=sigmoid(raw[:, 0]),
        harmonics=harmonics,
    )


def move_gaussians(gaussians: Gaussians, motion: F64) -> Gaussians:
    """The same Gaussians after a rigid motion (4, 4): means, rotations and harmonics turn together."""
    rotation = motion[:3, :3]
    return Gaussians(
        means=(gaussians.means @ rotation.T + motion[:3, 3]).astype(np.float32),
        rotations=multiply_quaternions(matrix_to_quaternion(rotation), gaussians.rotations),
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        harmonics=rotate_harmonics(np.asarray(gaussians.harmonics, np.float32), rotation),
    )


def fuse_voxels(points: F64, features: F32, confidence: F32, voxel_size: float) -> tuple[F64, F32]:
    """Average points and raw features (before any activation) within cells of space.

    The weights are a softmax of ``confidence`` within the cell, with 1e-6 added to its denominator as published; the
    cells come in lexicographic order of (x, y, z).
    """
    cells = np.rint(points.astype(np.float32) / np.float32(voxel_size)).astype(np.int64)
    order = np.lexsort((cells[:, 2], cells[:, 1], cells[:, 0]))
    if len(order) == 0:
        return points, features
    new = np.ones(len(order), np.bool_)
    new[1:] = (np.diff(cells[order], axis=0) != 0).any(1)
    starts = np.flatnonzero(new)
    owner = np.cumsum(new) - 1
    sorted_confidence = confidence[order].astype(np.float64)
    highest = np.maximum.reduceat(sorted_confidence, starts)
    weights = np.exp(sorted_confidence - highest[owner])
    weights /= (np.add.reduceat(weights, starts) + 1e-6)[owner]
    fused_points = np.add.reduceat(points[order] * weights[:, None], starts, axis=0)
    fused_features = np.add.reduceat(features[order] * weights[:, None], starts, axis=0)
    return np.asarray(fused_points, np.float64), fused_features.astype(np.float32)


def rotate_harmonics(harmonics: F32, rotation: F64) -> F32:
    """Coefficients (n, k, 3) of the turned colour: its value in direction ``rotation @ d`` is the old one in ``d``.

    Degrees do not mix; with Y evaluated in fixed directions d, the matrix of one degree is pinv(Y(d)) Y(rotation^T d).
    """
    degree = isqrt(harmonics.shape[1]) - 1
    turned = np.array(harmonics, np.float32)
    if degree == 0:
        return turned
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    fixed, source = _basis(directions, degree), _basis(directions @ rotation, degree)
    for band in range(1, degree + 1):
        span = slice(band * band, (band + 1) * (band + 1))
        matrix = (np.linalg.pinv(fixed[:, span]) @ source[:, span]).astype(np.float32)
        turned[:, span] = matrix @ harmonics[:, span]
    return turned


def multiply_quaternions(first: NDArray[np.floating], second: NDArray[np.floating]) -> F32:
    """Quaternion (4,) ``first`` after quaternions (n, 4) ``second``, (w, x, y, z)."""
    w, x, y, z = np.asarray(first, np.float64)
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(second @ matrix.T, np.float32)


def map_opacity(probability: F32, exponent: float) -> F32:
    """AnySplat's opacity mapping: 0.5 (1 - (1-p)^e + p^(1/e)), e = 2^exponent; exponent 0 changes nothing."""
    power = 2.0**exponent
    p = probability.astype(np.float64)
    return np.asarray(np.clip(0.5 * (1 - (1 - p) ** power + p ** (1 / power)), 0, 1), np.float32)


def sigmoid(x: F32) -> F32:
    """1 / (1 + exp(-x)) without overflow."""
    return np.asarray(0.5 * (1 + np.tanh(0.5 * x)), np.float32)


def softplus(x: F32) -> F32:
    """log(1 + exp(x)) without overflow."""
    return np.logaddexp(np.float32(0), x).astype(np.float32)


def _basis(directions: F64, degree: int) -> F64:
    """(n, (degree + 1)^2) values of the basis functions in unit directions (n, 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack(harmonic_terms(x, y, z, degree), 1)


def _colour(raw: F32) -> F32:
    """(n, k, 3) raw colour channels, damped by degree: 1 for the constant, 0.1 * 0.25^l above."""
    count = (raw.shape[1] - 8) // 3
    damping = np.array([1.0 if k == 0 else 0.1 * 0.25 ** isqrt(k) for k in range(count)], np.float32)
    return np.ascontiguousarray(raw[:, 8:].reshape(len(raw), 3, count).transpose(0, 2, 1) * damping[:, None])


def _with_direction(quaternions: NDArray[np.floating]) -> F32:
    """Quaternions (n, 4), the identity where the raw values were zero and so have no direction."""
    checked = np.array(quaternions, np.float32)
    checked[~checked.any(1)] = (1, 0, 0, 0)
    return checked

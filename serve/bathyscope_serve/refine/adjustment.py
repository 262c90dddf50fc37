r"""Bundle adjustment: cameras and points that explain where points were seen.

With :math:`X_p` the point, :math:`(R_c, t_c)` the camera, :math:`Y = R_c X_p + t_c`, and a sight of it with ray
:math:`(x, y)`, focal length f in pixels and depth d of the frame's own,

.. math::
    \sum_{(p, c)} \rho_4\left(f^2 \left\| (Y_1, Y_2) / Y_3 - (x, y) \right\|^2\right)
        + \rho_1\left(\log^2 (Y_3 / d) / \tau_c^2\right), \qquad \rho_k(e) = k \log(1 + e / k)

is made small by Levenberg-Marquardt with the points eliminated. The second term is weak: where the camera hardly moves,
points stay where the frames have them; elsewhere the rays decide. The n_c sights of a camera together hold its scale
by about :math:`\tau_c / \sqrt{n_c}`, so :math:`\tau_c = \tau \min(1, \sqrt{n_c / 300})`: a camera that few points
tie to the others keeps the scale that the network gives it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, quaternion_to_matrix
from bathyscope_serve.refine.kernels import misfit, moved_points, normal_equations

I64 = NDArray[np.int64]

TOLERANCE = 3.0
"""Standard deviation of log depth, τ, in a camera with many sights."""
MANY = 300
"""Sights of a camera."""
_ROUNDS = 20
_ENOUGH = 1e-4
_DAMPING = 1e-3


@dataclass(frozen=True, slots=True)
class Sights:
    """m sights of n points by c cameras, sorted by point."""

    point: I64
    """(m,) rising, every number from 0 to n - 1."""
    camera: I64
    """(m,)"""
    numbers: F64
    """(m, 4) ray x and y, focal length in pixels, logarithm of the depth or NaN."""

    @property
    def tolerance(self) -> F64:
        """(m,) standard deviation of log depth, τ_c."""
        count = np.bincount(self.camera)
        return np.asarray(TOLERANCE * np.minimum(1.0, np.sqrt(count / MANY))[self.camera], np.float64)

    @property
    def start(self) -> I64:
        """(n + 1,) first sight of each point."""
        count = int(self.point[-1]) + 1 if len(self.point) else 0
        return np.searchsorted(self.point, np.arange(count + 1)).astype(np.int64)


@dataclass(frozen=True, slots=True)
class State:
    """Cameras and points."""

    rotation: F64
    """(c, 3, 3) camera from world."""
    translation: F64
    """(c, 3)"""
    points: F64
    """(n, 3)"""

    def seen(self, sights: Sights) -> F64:
        """Points (m, 3) in the cameras that see them."""
        turned = np.einsum("mij,mj->mi", self.rotation[sights.camera], self.points[sights.point])
        return np.asarray(turned + self.translation[sights.camera], np.float64)

    def misses(self, sights: Sights) -> F64:
        """Distances (m,) in pixels between where points are seen and where they should be; infinite behind a camera."""
        return misses(self.seen(sights), sights.numbers)


def misses(seen: F64, numbers: F64) -> F64:
    """Distances (m,) in pixels of points (m, 3) in a camera from their sights (m, 4); infinite behind it."""
    ahead = seen[:, 2] > 0
    depth = np.where(ahead, seen[:, 2], 1.0)
    off = seen[:, :2] / depth[:, None] - numbers[:, :2]
    return np.where(ahead, numbers[:, 2] * np.linalg.norm(off, axis=1), np.inf)


def adjust(sights: Sights, state: State, free: NDArray[np.bool_]) -> State:
    """The state from which no step leads further down.

    Args:
        sights: What was seen.
        state: Where to begin.
        free: (c,) cameras that may move; the others and the depths of the frames hold the world in place.
    """
    start, column = sights.start, np.where(free, np.cumsum(free) - 1, -1).astype(np.int64)
    equations = _Equations.empty(int(free.sum()), len(sights.point), len(state.points))
    cost, damping = _cost(start, sights, state), _DAMPING
    for _ in range(_ROUNDS):
        equations.fill(start, sights, column, state, damping)
        trial = equations.step(start, sights, column, state, free)
        trial_cost = _cost(start, sights, trial)
        if not trial_cost < cost:
            damping *= 10
            if damping > 1e4:
                break
            continue
        gained = cost - trial_cost
        state, cost, damping = trial, trial_cost, max(damping / 5, 1e-7)
        if gained < _ENOUGH * cost:
            break
    return state


def uncertainty(sights: Sights, state: State) -> F64:
    """Standard deviations (m,) of log depth, for rays half a pixel off and cameras that are certain.

    Large where a point was hardly seen from two sides, whatever the frames say about its depth.
    """
    seen = state.seen(sights)
    z = np.maximum(seen[:, 2], 1e-9)
    slope = np.zeros((len(z), 2, 3))
    focal = 2 * sights.numbers[:, 2]
    slope[:, 0, 0] = slope[:, 1, 1] = focal / z
    slope[:, 0, 2], slope[:, 1, 2] = -focal * seen[:, 0] / z**2, -focal * seen[:, 1] / z**2
    rotation = state.rotation[sights.camera]
    slope = slope @ rotation
    weight = 1 / (1 + state.misses(sights) ** 2 / 4)
    known = np.zeros((len(state.points), 3, 3))
    np.add.at(known, sights.point, np.einsum("mki,mkj,m->mij", slope, slope, weight))
    size = np.trace(known, axis1=1, axis2=2)[:, None, None]
    spread = np.linalg.inv(known + (1e-12 * size + 1e-12) * np.eye(3))
    ahead = rotation[:, 2]
    variance = np.einsum("mi,mij,mj->m", ahead, spread[sights.point], ahead)
    return np.asarray(np.sqrt(np.maximum(variance, 0)) / z, np.float64)


def _cost(start: I64, sights: Sights, state: State) -> float:
    numbers, work = sights.numbers, np.zeros((2, 3))
    cost = misfit(
        start, sights.camera, numbers, state.rotation, state.translation, state.points, sights.tolerance, work
    )
    return float(cost)


@dataclass(frozen=True, slots=True)
class _Equations:
    """Room for the normal equations."""

    matrix: F64
    right: F64
    diagonal: F64
    coupling: F64
    inverse: F64
    slope: F64

    @classmethod
    def empty(cls, free: int, sights: int, points: int) -> _Equations:
        return cls(
            np.zeros((6 * free, 6 * free)),
            np.zeros(6 * free),
            np.zeros(6 * free),
            np.zeros((sights, 6, 3)),
            np.zeros((points, 3, 3)),
            np.zeros((points, 3)),
        )

    def fill(self, start: I64, sights: Sights, column: I64, state: State, damping: float) -> None:
        normal_equations(
            start,
            sights.camera,
            column,
            sights.numbers,
            state.rotation,
            state.translation,
            state.points,
            sights.tolerance,
            damping,
            self.matrix,
            self.right,
            self.diagonal,
            self.coupling,
            self.inverse,
            self.slope,
            np.zeros((8, 6)),
        )

    def step(self, start: I64, sights: Sights, column: I64, state: State, free: NDArray[np.bool_]) -> State:
        """The state after one step; without free cameras only the points move."""
        size = len(self.right)
        ridge = (1e-12 * float(np.trace(self.matrix)) + 1e-30) * np.eye(size) if size else self.matrix
        change: F64 = np.zeros(0)
        if size:
            change = -np.asarray(np.linalg.solve(self.matrix + ridge, self.right), np.float64)
        points = np.empty_like(state.points)
        moved_points(
            start,
            sights.camera,
            column,
            self.coupling,
            self.inverse,
            self.slope,
            change,
            state.points,
            points,
            np.zeros(3),
        )
        turns, shifts = change.reshape(-1, 6)[:, :3], change.reshape(-1, 6)[:, 3:]
        rotation, translation = state.rotation.copy(), state.translation.copy()
        turned = rotations(turns)
        rotation[free] = turned @ rotation[free]
        translation[free] = (turned @ translation[free, :, None])[..., 0] + shifts
        return replace(state, rotation=rotation, translation=translation, points=points)


def rotations(vectors: F64) -> F64:
    """Rotations (n, 3, 3) about vectors (n, 3) by their lengths."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = vectors / np.maximum(angle, 1e-300)
    return quaternion_to_matrix(np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], 1))

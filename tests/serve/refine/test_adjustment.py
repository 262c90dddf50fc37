"""Bundle adjustment against worlds that are known, and its equations against derivatives taken by differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bathyscope.camera import F64, rotation_angle
from bathyscope_serve.refine.adjustment import MANY, TOLERANCE, Sights, State, adjust, rotations, uncertainty
from bathyscope_serve.refine.kernels import LOOSE, misfit, normal_equations

FOCAL = 300.0


def world(seed: int, cameras: int = 6, points: int = 80) -> tuple[Sights, State]:
    """Cameras that move sideways before a rough wall, and exact sights of it by all of them."""
    rng = np.random.default_rng(seed)
    rotation = rotations(0.05 * rng.normal(size=(cameras, 3)))
    centres = np.stack([np.linspace(0, 1, cameras), *(0.05 * rng.normal(size=(2, cameras)))], 1)
    translation = -np.einsum("cij,cj->ci", rotation, centres)
    places = np.stack([*rng.uniform(-2, 2, (2, points)), rng.uniform(4, 9, points)], 1)
    point = np.repeat(np.arange(points), cameras)
    camera = np.tile(np.arange(cameras), points)
    state = State(rotation, translation, places)
    sights = Sights(point, camera, np.zeros((len(point), 4)))
    seen = state.seen(sights)
    numbers = np.stack(
        [seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2], np.full(len(seen), FOCAL), np.log(seen[:, 2])], 1
    )
    return replace(sights, numbers=numbers), state


def shaken(state: State, seed: int, free: np.ndarray, amount: float = 0.02) -> State:
    """The state with wrong free cameras and wrong points."""
    rng = np.random.default_rng(seed)
    turn = rotations(amount * rng.normal(size=(len(free), 3)) * free[:, None])
    shift = amount * rng.normal(size=(len(free), 3)) * free[:, None]
    return State(
        turn @ state.rotation, state.translation + shift, state.points * rng.uniform(0.8, 1.25, (len(state.points), 1))
    )


def worst_turn(found: State, truth: State) -> float:
    return float(rotation_angle(found.rotation @ np.swapaxes(truth.rotation, 1, 2)).max())


@pytest.mark.parametrize("seed", range(3))
def test_cameras_and_points_come_back_to_where_they_were(seed: int) -> None:
    sights, truth = world(seed)
    free = np.array([False, False, True, True, True, True])
    found = adjust(sights, shaken(truth, seed, free), free)
    assert worst_turn(found, truth) < 1e-4
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-3)
    np.testing.assert_allclose(found.points, truth.points, atol=5e-3)
    assert np.median(found.misses(sights)) < 0.01
    np.testing.assert_array_equal(found.rotation[:2], truth.rotation[:2])


def test_a_fifth_of_wrong_sights_hardly_matter() -> None:
    sights, truth = world(3, points=150)
    free = np.array([False, False, True, True, True, True])
    wrong = np.random.default_rng(0).uniform(size=len(sights.point)) < 0.2
    numbers = sights.numbers.copy()
    numbers[wrong, :2] += 0.2 * np.random.default_rng(1).normal(size=(int(wrong.sum()), 2))
    found = adjust(replace(sights, numbers=numbers), shaken(truth, 3, free), free)
    assert np.degrees(worst_turn(found, truth)) < 0.1


def test_points_that_are_seen_from_one_place_stay_where_the_frames_have_them() -> None:
    sights, truth = world(4)
    still = replace(truth, rotation=truth.rotation[[0] * 6], translation=truth.translation[[0] * 6])
    seen = still.seen(sights)
    rays = seen[:, :2] / seen[:, 2:]
    numbers = np.concatenate([rays, sights.numbers[:, 2:3], np.log(1.3 * seen[:, 2:])], 1)
    found = adjust(replace(sights, numbers=numbers), still, np.array([False] + [True] * 5))
    np.testing.assert_allclose(np.median(np.log(found.seen(sights)[:, 2] / seen[:, 2])), np.log(1.3), atol=0.02)
    assert np.median(uncertainty(sights, found)) > 1


def test_doubt_is_that_of_a_triangle() -> None:
    """Two cameras a baseline apart: half a pixel of each ray moves log depth by z / (f b), halved, times √2."""
    depth, baseline = 5.0, 0.5
    state = State(
        np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-baseline, 0, 0]]), np.array([[baseline / 2, 0, depth]])
    )
    point, camera = np.zeros(2, np.int64), np.arange(2)
    rays = state.seen(Sights(point, camera, np.zeros((2, 4))))
    numbers = np.stack([rays[:, 0] / depth, rays[:, 1] / depth, np.full(2, FOCAL), np.full(2, np.nan)], 1)
    expected = 0.5 * np.sqrt(2) * depth / (FOCAL * baseline)
    np.testing.assert_allclose(uncertainty(Sights(point, camera, numbers), state), expected, rtol=1e-3)


def dense_step(sights: Sights, state: State, damping: float) -> tuple[F64, F64]:
    """The damped Gauss-Newton step of cameras and points, with derivatives by differences and nothing eliminated."""

    def residuals(change: F64) -> F64:
        cameras, points = change[:18].reshape(3, 6), change[18:].reshape(-1, 3)
        turn = rotations(cameras[:, :3])
        moved = State(
            np.concatenate([state.rotation[:1], turn @ state.rotation[1:]]),
            np.concatenate([state.translation[:1], (turn @ state.translation[1:, :, None])[..., 0] + cameras[:, 3:]]),
            state.points + points,
        )
        seen = moved.seen(sights)
        off = sights.numbers[:, 2:3] * (seen[:, :2] / seen[:, 2:] - sights.numbers[:, :2])
        return np.concatenate([off, ((np.log(seen[:, 2]) - sights.numbers[:, 3]) / sights.tolerance)[:, None]], 1)

    size = 18 + 3 * len(state.points)
    at = residuals(np.zeros(size))
    eps = 1e-6
    slope = np.stack([(residuals(eps * e) - residuals(-eps * e)) / (2 * eps) for e in np.eye(size)], -1)
    far, near = 1 / (1 + (at[:, :2] ** 2).sum(1) / LOOSE), 1 / (1 + at[:, 2] ** 2)
    weight = np.stack([far, far, near], 1).ravel()
    slope = slope.reshape(-1, size)
    square = slope.T @ (slope * weight[:, None])
    change = -np.linalg.solve(square + damping * np.diag(np.diag(square)), slope.T @ (weight * at.ravel()))
    return change[:18], change[18:].reshape(-1, 3)


def test_the_equations_are_those_of_a_plain_gauss_newton_step() -> None:
    sights, truth = world(5, cameras=4, points=9)
    free = np.array([False, True, True, True])
    state = shaken(truth, 5, free)
    damping = 1e-2
    expected, moved = dense_step(sights, state, damping)
    matrix, right, diagonal = np.zeros((18, 18)), np.zeros(18), np.zeros(18)
    coupling, inverse, slope = np.zeros((len(sights.point), 6, 3)), np.zeros((9, 3, 3)), np.zeros((9, 3))
    column = np.array([-1, 0, 1, 2])
    normal_equations(
        sights.start, sights.camera, column, sights.numbers, state.rotation, state.translation, state.points,
        sights.tolerance, damping, matrix, right, diagonal, coupling, inverse, slope, np.zeros((8, 6)),
    )  # fmt: skip
    found = -np.linalg.solve(matrix, right)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)
    pull = slope.copy()
    np.add.at(pull, sights.point, np.einsum("mki,mk->mi", coupling, found.reshape(3, 6)[column[sights.camera]]))
    np.testing.assert_allclose(-np.einsum("nij,nj->ni", inverse, pull), moved, rtol=1e-3, atol=1e-6)


def test_the_cost_is_the_formula_of_the_docstring() -> None:
    sights, truth = world(6)
    state = shaken(truth, 6, np.ones(6, np.bool_))
    seen = state.seen(sights)
    off = FOCAL * (seen[:, :2] / seen[:, 2:] - sights.numbers[:, :2])
    depth = (np.log(seen[:, 2]) - sights.numbers[:, 3]) / sights.tolerance
    expected = (4 * np.log1p((off**2).sum(1) / 4) + np.log1p(depth**2)).sum()
    found = misfit(
        sights.start, sights.camera, sights.numbers, state.rotation, state.translation, state.points,
        sights.tolerance, np.zeros((2, 3)),
    )  # fmt: skip
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_sights_of_a_camera_hold_its_scale_equally_firmly_however_few_they_are() -> None:
    camera = np.repeat([0, 1, 2], [12, MANY, 4 * MANY])
    sights = Sights(np.arange(len(camera)), camera, np.zeros((len(camera), 4)))
    information = np.bincount(camera, weights=1 / sights.tolerance**2)
    np.testing.assert_allclose(information / (MANY / TOLERANCE**2), [1, 1, 4])


def test_a_point_behind_a_camera_costs_much_and_pulls_at_nothing() -> None:
    sights, truth = world(7)
    free = np.array([False] + [True] * 5)
    behind = truth.points.copy()
    behind[0, 2] = -3
    found = adjust(sights, replace(truth, points=behind), free)
    assert np.isfinite(found.translation).all()
    assert np.isinf(replace(truth, points=behind).misses(sights)[:6]).all()
    assert worst_turn(found, truth) < 1e-3

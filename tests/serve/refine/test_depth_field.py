"""The correction of a frame's depth, against corrections that are known."""

from __future__ import annotations

import numpy as np
import pytest

from bathyscope_serve.refine.depth_field import DepthField, KnownDepths, fit_field, plain_field

SIZE = (112, 140)


def points(count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    return rng.uniform(0, 1, (count, 2)) * SIZE[::-1], rng.normal(2, 0.4, count)


def fit(places: np.ndarray, own: np.ndarray, found: np.ndarray, before: DepthField = plain_field(1.0)) -> DepthField:
    return fit_field(KnownDepths(places, own, found, np.full(len(own), 0.02)), SIZE, before)


def test_a_scale_and_a_slope_are_found_and_applied() -> None:
    places, own = points()
    u, v = (places / SIZE[::-1] * 2 - 1).T
    found = fit(places, own, own + 0.3 + 0.1 * u - 0.05 * v)
    depth = np.full(SIZE, 5, np.float32)
    applied = found.applied(depth, np.ones(SIZE, np.bool_))
    np.testing.assert_allclose(applied[56, 70], 5 * np.exp(0.3), rtol=0.01)
    assert applied[56, -1] / applied[56, 0] == pytest.approx(np.exp(0.2), rel=0.02)
    np.testing.assert_array_equal(found.applied(depth, np.zeros(SIZE, np.bool_)), depth)


def test_a_third_of_wrong_points_hardly_moves_it() -> None:
    places, own = points()
    wrong = own + 0.3
    wrong[::3] += 2
    found = fit(places, own, wrong)
    assert found.values[0] == pytest.approx(0.3, abs=0.02)


def test_a_dent_is_found_where_the_points_are() -> None:
    places, own = points(600)
    u, v = (places / SIZE[::-1] * 2 - 1).T
    dent = 0.15 * np.exp(-8 * ((u - 0.4) ** 2 + (v + 0.3) ** 2))
    found = fit(places, own, own + dent)
    depth = found.applied(np.full(SIZE, np.exp(2.0), np.float32), np.ones(SIZE, np.bool_))
    at_dent, far_off = depth[int(0.35 * 112), int(0.7 * 140)], depth[int(0.8 * 112), int(0.2 * 140)]
    assert np.log(at_dent / far_off) == pytest.approx(0.15, abs=0.03)


def test_few_points_leave_the_scale_of_the_frame_before() -> None:
    places, own = points(7)
    found = fit(places, own, own, plain_field(1.5))
    np.testing.assert_allclose(found.applied(np.ones(SIZE, np.float32), np.ones(SIZE, np.bool_)), 1.5, rtol=1e-6)


def test_what_the_points_do_not_show_is_not_made_up() -> None:
    """All points in one corner say nothing about the others: they get the common factor."""
    places, own = points()
    places = places / 8
    noise = 0.05 * np.random.default_rng(0).normal(size=300)
    found = fit(places, own, own + 0.2 + noise)
    depth = found.applied(np.full(SIZE, np.exp(2.0), np.float32), np.ones(SIZE, np.bool_))
    np.testing.assert_allclose(np.log(depth[60:, 70:]) - 2, 0.2, atol=0.1)
    np.testing.assert_allclose(np.log(depth[:14, :17]).mean() - 2, 0.2, atol=0.02)

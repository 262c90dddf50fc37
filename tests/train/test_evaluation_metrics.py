"""Depth errors and median scaling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.alignment import median_scale
from bathyscope_train.evaluation.baselines import brightness_depth, constant_depth
from bathyscope_train.evaluation.metrics import DepthErrors, depth_errors, mean_errors


def test_errors_of_three_pixels_are_those_worked_out_by_hand() -> None:
    errors = depth_errors(np.array([1.0, 2.0, 4.0]), np.array([1.2, 2.0, 5.0]))
    assert errors.abs_rel == pytest.approx((0.2 + 0.0 + 0.25) / 3)
    assert errors.sq_rel == pytest.approx((0.04 + 0.0 + 0.25) / 3)
    assert errors.rmse == pytest.approx(math.sqrt((0.04 + 0.0 + 1.0) / 3))
    assert errors.rmse_log == pytest.approx(math.sqrt((math.log(1.2) ** 2 + math.log(1.25) ** 2) / 3))
    assert (errors.delta1, errors.delta2, errors.delta3) == (pytest.approx(2 / 3), 1.0, 1.0)


@pytest.mark.parametrize(("factor", "within"), [(1.25, 0), (1.249, 1), (1 / 1.25, 0), (1 / 1.249, 1)])
def test_delta1_takes_ratios_strictly_below_its_bound_on_both_sides(factor: float, within: int) -> None:
    assert depth_errors(np.array([4.0]), np.array([4.0 * factor])).delta1 == within


def test_the_errors_of_a_clip_are_the_mean_of_its_frames_not_pooled() -> None:
    small, large = depth_errors(np.ones(1), np.full(1, 2.0)), depth_errors(np.ones(99), np.full(99, 4.0))
    assert mean_errors([small, large]).rmse == pytest.approx((1.0 + 3.0) / 2)


def test_frames_without_a_pixel_do_not_count() -> None:
    measured = depth_errors(np.ones(3), np.full(3, 1.5))
    nothing = depth_errors(np.zeros(0), np.zeros(0))
    assert all(math.isnan(value) for value in nothing.as_dict().values())
    assert mean_errors([nothing, measured, nothing]) == measured
    assert math.isnan(mean_errors([nothing]).abs_rel)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_depth_that_is_not_positive_and_finite_is_refused(bad: float) -> None:
    with pytest.raises(GeometryError, match="predicted depth"):
        depth_errors(np.array([1.0, 1.0]), np.array([1.0, bad]))
    with pytest.raises(GeometryError, match="true depth"):
        depth_errors(np.array([1.0, bad]), np.array([1.0, 1.0]))


def test_lists_of_different_length_are_refused() -> None:
    with pytest.raises(GeometryError, match=r"\(2,\) and \(3,\)"):
        depth_errors(np.ones(2), np.ones(3))


@given(st.lists(st.floats(0.1, 100.0), min_size=1, max_size=20), st.floats(0.01, 100.0))
def test_a_prediction_right_up_to_scale_has_no_error_after_median_scaling(depths: list[float], factor: float) -> None:
    truth = np.array(depths)
    scale = median_scale([truth], [truth * factor])
    assert scale == pytest.approx(1 / factor)
    errors: DepthErrors = depth_errors(truth, scale * truth * factor)
    assert errors.abs_rel == pytest.approx(0.0, abs=1e-12)
    assert errors.delta1 == 1.0


def test_the_median_runs_over_all_frames_of_the_clip_together() -> None:
    truth = [np.array([1.0, 1.0, 1.0, 1.0]), np.array([10.0])]
    predicted = [np.array([2.0, 2.0, 2.0, 2.0]), np.array([100.0])]
    assert median_scale(truth, predicted) == 0.5


def test_the_scale_is_a_ratio_of_medians_not_a_median_of_ratios() -> None:
    assert median_scale([np.array([1.0, 2.0, 9.0])], [np.array([1.0, 4.0, 3.0])]) == pytest.approx(2.0 / 3.0)


@pytest.mark.parametrize("predicted", [np.zeros(3), np.zeros(0), np.full(3, np.nan)])
def test_median_scaling_of_nothing_is_refused(predicted: np.ndarray) -> None:
    with pytest.raises(GeometryError, match="median scaling needs"):
        median_scale([np.ones(len(predicted))], [predicted])


def test_a_quarter_of_the_light_is_twice_as_far() -> None:
    frame = np.zeros((1, 2, 3), np.uint8)
    frame[0, 0], frame[0, 1] = 200, 50
    depth = brightness_depth(frame)
    assert depth[0, 1] / depth[0, 0] == pytest.approx(2.0)


def test_black_pixels_have_the_depth_of_one_grey_level() -> None:
    frame = np.array([[[0, 0, 0], [1, 1, 1]]], np.uint8)
    depth = brightness_depth(frame)
    assert depth[0, 0] == pytest.approx(depth[0, 1])


def test_constant_depth_is_the_same_everywhere() -> None:
    assert np.unique(constant_depth(np.zeros((3, 4, 3), np.uint8))).size == 1

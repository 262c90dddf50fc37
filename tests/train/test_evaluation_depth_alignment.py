"""Exact streaming medians, and the alignments that are fitted on pixels in pieces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.depth_alignment import Alignment, AlignmentKind, fit_alignment
from bathyscope_train.evaluation.median import StreamingMedian

numbers = st.floats(-1e6, 1e6, width=32)


def streamed(values: np.ndarray, pieces: int) -> StreamingMedian:
    median = StreamingMedian()
    for piece in np.array_split(values, pieces):
        median.coarse(piece)
    for piece in np.array_split(values, pieces):
        median.fine(piece)
    return median


@settings(max_examples=40, deadline=None)
@given(st.lists(numbers, min_size=1, max_size=60), st.integers(1, 5))
def test_a_streamed_median_is_the_median(values: list[float], pieces: int) -> None:
    array = np.array(values, np.float32)
    found = streamed(array, pieces)
    assert found.median() == float(np.median(array))
    spread = np.abs(array.astype(np.float64) - found.median()).mean()
    assert found.mean_absolute_deviation() == pytest.approx(spread, rel=1e-9, abs=1e-9)


def test_infinite_values_count_as_large_ones() -> None:
    assert streamed(np.array([1, 2, np.inf, np.inf, 3], np.float32), 2).median() == 3.0


def test_a_median_of_nothing_or_of_nan_is_refused() -> None:
    with pytest.raises(GeometryError, match="at least one value"):
        StreamingMedian().median()
    with pytest.raises(GeometryError, match="NaN"):
        StreamingMedian().coarse(np.array([1, np.nan], np.float32))


def pixels(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.uniform(20, 120, count).astype(np.float32), rng.uniform(0.2, 3, count).astype(np.float32)


@pytest.mark.parametrize("kind", ["scale", "scale_shift", "affine_disparity"])
def test_an_alignment_does_not_depend_on_how_pixels_are_cut_into_pieces(kind: AlignmentKind) -> None:
    g, p = pixels()
    whole = fit_alignment(kind, lambda: [(g, p)])
    cut = fit_alignment(kind, lambda: zip(np.array_split(g, 7), np.array_split(p, 7), strict=True))
    assert (cut.scale, cut.shift) == pytest.approx((whole.scale, whole.shift), rel=1e-12)


def test_the_robust_fit_recovers_scale_and_shift() -> None:
    g, _ = pixels()
    found = fit_alignment("scale_shift", lambda: [(g, (g - 7) / 3)])
    assert (found.scale, found.shift) == pytest.approx((3, 7), rel=1e-4)


def test_the_fit_in_disparity_recovers_disparity_that_is_right_up_to_scale_and_shift() -> None:
    g, _ = pixels()
    disparity = (1 / g.astype(np.float64) - 0.002) / 5
    found = fit_alignment("affine_disparity", lambda: [(g, (1 / disparity).astype(np.float32))])
    assert (found.scale, found.shift) == pytest.approx((5, 0.002), rel=1e-3)
    assert found.depth(1 / disparity) == pytest.approx(g, rel=1e-4)


def test_the_fit_in_disparity_is_the_least_squares_one() -> None:
    g, p = pixels(50)
    found = fit_alignment("affine_disparity", lambda: [(g, p)])
    design = np.stack([1 / p.astype(float), np.ones(len(p))], -1)
    (scale, shift), *_ = np.linalg.lstsq(design, 1 / (g.astype(float) + 1e-8), rcond=None)
    assert (found.scale, found.shift) == pytest.approx((scale, shift), rel=1e-6)


def test_disparity_that_is_not_positive_after_the_fit_is_infinitely_far() -> None:
    assert np.isinf(Alignment(scale=1.0, shift=-0.5, of_disparity=True).depth(np.array([4.0, np.inf]))).all()
    assert Alignment(scale=1.0, shift=0.5, of_disparity=True).depth(np.array([np.inf])) == pytest.approx(2.0)


@pytest.mark.parametrize("kind", ["scale_shift", "affine_disparity"])
def test_a_constant_prediction_has_no_shift_to_fit(kind: AlignmentKind) -> None:
    with pytest.raises(GeometryError, match="differ"):
        fit_alignment(kind, lambda: [(pixels(10)[0], np.ones(10, np.float32))])


def test_median_scaling_of_depth_that_is_zero_is_refused() -> None:
    with pytest.raises(GeometryError, match="positive"):
        fit_alignment("scale", lambda: [(np.ones(3, np.float32), np.zeros(3, np.float32))])


def test_without_alignment_depth_stays_as_it_is() -> None:
    assert fit_alignment("none", lambda: []).depth(np.array([3.0])) == 3.0

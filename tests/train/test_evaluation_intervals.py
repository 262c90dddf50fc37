"""Means and their intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bathyscope_train.evaluation.intervals import bootstrap_interval, grand_mean, student_interval

LONG, SHORT, EMPTY = np.array([1.0, 1.0, 1.0, np.nan]), np.array([5.0]), np.array([np.nan, np.nan])


def test_sequences_weigh_the_same_or_by_their_length() -> None:
    assert grand_mean([LONG, SHORT], "sequences") == 3.0
    assert grand_mean([LONG, SHORT], "frames") == 2.0


def test_frames_and_sequences_without_a_number_do_not_poison_a_mean() -> None:
    assert grand_mean([LONG, EMPTY, SHORT], "sequences") == 3.0
    assert np.isnan(grand_mean([EMPTY], "sequences"))
    assert np.isnan(grand_mean([], "frames"))


def test_one_video_has_no_interval() -> None:
    assert bootstrap_interval([LONG, EMPTY], "sequences") is None


@pytest.mark.parametrize("averaging", ["sequences", "frames"])
def test_the_bootstrap_interval_of_many_sequences_is_that_of_their_means(averaging: str) -> None:
    """For many sequences of one length it must come near the normal interval of their means."""
    means = np.random.default_rng(0).normal(2, 1, 400)
    found = bootstrap_interval([np.full(3, mean) for mean in means], averaging)  # type: ignore[arg-type]
    half = 1.96 * means.std() / 20
    assert found == pytest.approx((means.mean() - half, means.mean() + half), abs=0.02)
    assert found == bootstrap_interval([np.full(3, mean) for mean in means], averaging)  # type: ignore[arg-type]


def test_the_published_interval_is_students() -> None:
    values = np.array([1.0, 2.0, 4.0, 7.0])
    expected = stats.t.interval(0.95, 3, loc=values.mean(), scale=stats.sem(values))
    assert student_interval(values) == pytest.approx(expected)
    assert student_interval(values[:1]) is None

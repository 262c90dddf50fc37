"""The eight-wide instructions of the splatting kernels against numpy."""

from __future__ import annotations

from typing import Any

import numpy as np

from bathyscope.splat import lanes
from bathyscope.splat.jit import kernel
from bathyscope.splat.lanes import load, store


@kernel
def powers(source: Any, out: Any) -> None:
    for at in range(0, len(source), 8):
        store(out, at, lanes.exp2(load(source, at)))


@kernel
def logarithms(source: Any, out: Any) -> None:
    for at in range(0, len(source), 8):
        store(out, at, lanes.log2(load(source, at)))


@kernel
def masks(source: Any, bound: Any, out: Any) -> None:
    for at in range(0, len(source), 8):
        out[at // 8] = lanes.bits(load(source, at) >= bound)


@kernel
def sums_of_eight(source: Any, out: Any) -> None:
    rows = (
        lanes.sums(
            load(source, 0),
            load(source, 8),
            load(source, 16),
            load(source, 24),
            load(source, 32),
            load(source, 40),
            load(source, 48),
            load(source, 56),
        ),
    )
    store(out, 0, rows[0])


def test_eight_sums_come_in_the_order_of_the_arguments() -> None:
    numbers = np.random.default_rng(0).integers(0, 1000, (8, 8)).astype(np.float32)
    found = np.empty(8, np.float32)
    sums_of_eight(numbers, found)
    assert found.tolist() == numbers.sum(1).tolist()


def test_powers_of_two_are_right_to_rounding() -> None:
    exponents = np.linspace(-30, 3, 8000, dtype=np.float32)
    found = np.empty_like(exponents)
    powers(exponents, found)
    np.testing.assert_allclose(found, np.exp2(exponents.astype(np.float64)), rtol=4e-7)


def test_whole_powers_are_nearly_exact() -> None:
    exponents = np.arange(-8, 8, dtype=np.float32)
    found = np.empty_like(exponents)
    powers(exponents, found)
    np.testing.assert_allclose(found, 2.0**exponents, rtol=1.3e-7)


def test_logarithms_are_right_to_rounding() -> None:
    numbers = np.geomspace(1e-12, 1e6, 8000).astype(np.float32)
    found = np.empty_like(numbers)
    logarithms(numbers, found)
    np.testing.assert_allclose(found, np.log2(numbers.astype(np.float64)), rtol=2e-7, atol=3e-7)


def test_a_mask_has_lane_0_in_its_lowest_bit_and_nan_in_none() -> None:
    numbers = np.array([1, 0, np.nan, 5, -1, 1, np.inf, 0.5] + [0] * 7 + [2], np.float32)
    found = np.empty(2, np.uint64)
    masks(numbers, np.float32(1), found)
    assert found.tolist() == [0b01101001, 0b10000000]

"""Windows of a stream with key frames, and their stitching by scale and shift."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from bathyscope.affine_stitch import AffineStitcher, fit_affine
from bathyscope.errors import GeometryError
from bathyscope.keyed_windows import KeyedWindows, keyed_windows

SMALL = KeyedWindows(length=8, key_places=(0, 3, 6, 7), blend=2)
BLENDED = KeyedWindows(length=8, key_places=(2, 3, 6, 7), blend=2, fit="blended")


def written_out(count: int, rule: KeyedWindows) -> list[list[int]]:
    """The rule as the specification words it: pad the list, cut at 0, stride, ..., replace the leading inputs."""
    stride, keys = rule.stride, list(rule.key_places)
    padded = list(range(count)) + [count - 1] * ((stride - count % stride) % stride + len(keys))
    windows: list[list[int]] = []
    for start in range(0, count, stride):
        window = padded[start : start + rule.length]
        window += [count - 1] * (rule.length - len(window))
        if windows:
            window[: len(keys)] = [windows[-1][place] for place in keys]
        windows.append(window)
    return windows


@given(count=st.integers(1, 120), rule=st.sampled_from([KeyedWindows(), SMALL, BLENDED]))
@settings(max_examples=80, deadline=None)
def test_windows_of_a_stream_are_those_of_the_padded_list(count: int, rule: KeyedWindows) -> None:
    windows = list(keyed_windows(iter(range(count)), rule))
    assert [list(window.items) for window in windows] == written_out(count, rule)
    assert sum(window.fresh for window in windows) == count


def test_an_empty_stream_has_no_window() -> None:
    assert list(keyed_windows(iter(()), KeyedWindows())) == []


def test_windows_are_read_no_further_than_needed() -> None:
    read: list[int] = []

    def stream() -> object:
        for item in range(100):
            read.append(item)
            yield item

    windows = keyed_windows(stream(), SMALL)  # type: ignore[arg-type]
    next(windows)
    assert len(read) == 8
    next(windows)
    assert len(read) == 12


def true_map(frame: int) -> np.ndarray:
    return (np.linspace(1, 2, 12).reshape(3, 4) + 0.05 * frame).astype(np.float32)


def stitched(count: int, rule: KeyedWindows) -> tuple[np.ndarray, AffineStitcher, list[int]]:
    """Every window sees the truth through a scale and shift of its own."""
    stitcher = AffineStitcher(rule)
    maps: list[np.ndarray] = []
    held: list[int] = []
    given = 0
    for number, window in enumerate(keyed_windows(range(count), rule)):
        scale, shift = (1.0, 0.0) if number == 0 else (0.5 + 0.2 * number, 0.3)
        seen = np.stack([true_map(frame) for frame in window.items]) * np.float32(scale) + np.float32(shift)
        maps.extend(stitcher.add(seen.astype(np.float32), window.fresh))
        given += window.fresh
        held.append(given - len(maps))
    maps.extend(stitcher.finish())
    return np.stack(maps), stitcher, held


@pytest.mark.parametrize("rule", [KeyedWindows(), SMALL, BLENDED], ids=["published", "small", "blended"])
@pytest.mark.parametrize("count", [1, 5, 8, 23, 70])
def test_windows_that_differ_by_scale_and_shift_give_the_truth(rule: KeyedWindows, count: int) -> None:
    observed, stitcher, held = stitched(count, rule)
    expected = np.stack([true_map(frame) for frame in range(count)])
    np.testing.assert_allclose(observed, expected, rtol=2e-4)
    assert max(held) <= rule.blend
    for number, (scale, shift) in enumerate(stitcher.affine, 1):
        assert scale == pytest.approx(1 / (0.5 + 0.2 * number), rel=1e-3)
        assert shift == pytest.approx(-0.3 * scale, abs=5e-3)


def test_metric_windows_are_blended_but_never_rescaled() -> None:
    rule = SMALL.model_copy(update={"fit": "none"})
    stitcher = AffineStitcher(rule)
    observed = [*stitcher.add(np.ones((8, 1, 1), np.float32), 8), *stitcher.add(np.full((8, 1, 1), 3, np.float32), 4)]
    observed.extend(stitcher.finish())
    assert np.ravel(observed).tolist() == [1.0] * 6 + [1.0, 3.0] + [3.0] * 4
    assert stitcher.affine == []


def test_values_below_zero_after_mapping_become_zero() -> None:
    ramp = np.tile(np.linspace(0, 1, 8, dtype=np.float32).reshape(1, 2, 4), (8, 1, 1))
    stitcher = AffineStitcher(SMALL)
    list(stitcher.add(ramp, 8))
    shifted = ramp + 1
    shifted[4:] = 0.5  # maps to -0.5
    observed = [*stitcher.add(shifted, 4), *stitcher.finish()]
    assert np.stack(observed[-4:]).max() == 0


def test_a_flat_map_determines_no_scale() -> None:
    assert fit_affine(np.zeros((2, 3, 3), np.float32), np.ones((2, 3, 3), np.float32)) == (1.0, 0.0)


def test_a_window_of_another_length_is_refused() -> None:
    with pytest.raises(GeometryError, match=r"8 maps .* shape \(7, 2, 2\)"):
        list(AffineStitcher(SMALL).add(np.ones((7, 2, 2), np.float32), 7))


@pytest.mark.parametrize(
    "changed",
    [
        {"key_places": (0, 3, 5, 7)},
        {"key_places": (3, 0, 6, 7)},
        {"key_places": (0, 3, 7, 8)},
        {"key_places": (6, 7)},
        {"key_places": tuple(range(8)), "blend": 2},
    ],
    ids=["end is not blended", "falling", "outside", "no reference", "nothing fresh"],
)
def test_key_places_that_cannot_work_are_refused(changed: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        KeyedWindows.model_validate(SMALL.model_dump() | changed)

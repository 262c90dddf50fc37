"""Windows over a stream of unknown length, and cuts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bathyscope.vision.cuts import CutDetector, CutSettings
from bathyscope_serve.windows import cut_windows


def stream(*shots: int) -> list[tuple[int, bool]]:
    """Numbered items; each shot's first one is marked."""
    marks = [place == 0 for shot in shots for place in range(shot)]
    return list(enumerate(marks))


def test_windows_overlap_and_the_last_is_moved_back_until_it_is_full() -> None:
    found = [(window.items, window.shared) for window in cut_windows(stream(11), 5, 2)]
    assert found == [((0, 1, 2, 3, 4), 0), ((3, 4, 5, 6, 7), 2), ((6, 7, 8, 9, 10), 2)]
    found = [(window.items, window.shared) for window in cut_windows(stream(9), 5, 2)]
    assert found[-1] == ((4, 5, 6, 7, 8), 4)


def test_no_window_spans_a_cut() -> None:
    found = [(window.items, window.shared) for window in cut_windows(stream(6, 1, 2), 5, 2)]
    assert found == [((0, 1, 2, 3, 4), 0), ((1, 2, 3, 4, 5), 4), ((6,), 0), ((7, 8), 0)]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=4), st.integers(2, 9), st.data())
def test_every_item_is_fresh_once_and_windows_are_full_where_they_can_be(
    shots: list[int], length: int, data: st.DataObject
) -> None:
    overlap = data.draw(st.integers(1, length - 1))
    found = list(cut_windows(stream(*shots), length, overlap))
    fresh = [item for window in found for item in window.items[window.shared :]]
    assert fresh == list(range(sum(shots)))
    starts = np.concatenate([[0], np.cumsum(shots)])
    for before, window in zip([None, *found], found, strict=False):
        shot = int(np.searchsorted(starts, window.items[0], "right")) - 1
        assert len(window.items) == min(length, shots[shot])
        assert window.items[-1] < starts[shot + 1]
        if window.shared:
            assert before is not None
            assert window.shared >= overlap
            assert before.items[-window.shared :] == window.items[: window.shared]


def picture(seed: int, shift: int = 0, gain: float = 1.0) -> np.ndarray:
    """Smooth random colours that can be moved and dimmed."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(size=(3, 6, 6)) * rng.uniform(0.3, 1, (3, 1, 1))
    image = np.kron(coarse, np.ones((12, 12)))
    return np.roll(gain * image, shift, 2).astype(np.float32)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([picture(1, shift) for shift in range(0, 60, 5)], []),
        ([picture(1, 0, gain) for gain in (1.0, 0.8, 0.5, 0.9, 1.0)], []),
        ([picture(1, i) for i in range(6)] + [picture(2, i) for i in range(6)], [6]),
        ([picture(seed) for seed in (1, 2)], [1]),
        ([np.zeros((3, 72, 72), np.float32)] * 4, []),
    ],
    ids=["motion", "light", "cut", "cut_at_once", "black"],
)
def test_cuts_are_told_from_motion_and_light(frames: list[np.ndarray], expected: list[int]) -> None:
    detector = CutDetector(CutSettings(), np.ones((72, 72), np.bool_))
    assert [i for i, frame in enumerate(frames) if detector.is_cut(frame)] == expected

"""Telling cuts from motion and light."""

from __future__ import annotations

import numpy as np
import pytest

from bathyscope.vision.cuts import CutDetector, CutSettings


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

"""The errors that only Video Depth Anything's benchmark reports, in the way in which it averages each of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Frames = Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]
"""True and aligned depth (n,) of the pixels of each frame, positive."""


def log10_error(frames: Frames) -> float:
    """Mean of ``|log10 g - log10 p|`` over the pixels of all frames together, unlike the other errors."""
    return float(np.concatenate([np.abs(d) for d in _logs(frames)]).mean() / np.log(10.0))


def inverse_rmse(frames: Frames) -> float:
    """Root mean square of ``1/g - 1/p``, mean over frames."""
    roots = [float(np.sqrt(np.mean((1.0 / np.float64(g) - 1.0 / np.float64(p)) ** 2))) for g, p in frames if len(g)]
    return float(np.mean(roots))


def silog_error(frames: Frames) -> float:
    """100 times the root of the mean over frames of the variance of ``ln g - ln p``: the root comes last."""
    return float(100.0 * np.sqrt(np.mean([d.var() for d in _logs(frames)])))


def _logs(frames: Frames) -> list[NDArray[np.float64]]:
    return [np.log(np.asarray(g, np.float64)) - np.log(np.asarray(p, np.float64)) for g, p in frames if len(g)]

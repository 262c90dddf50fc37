"""What brings predicted depth to the scale of the truth: one function of depth for a frame or for a sequence.

All of them are fitted on pixels ``(g, p)`` of true and predicted positive depth that come in pieces, so that a
sequence of any length needs the memory of one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError
from bathyscope_train.evaluation.median import StreamingMedian

AlignmentKind = Literal["none", "scale", "scale_shift", "affine_disparity"]
Pixels = tuple[NDArray[np.float32], NDArray[np.float32]]
"""True and predicted depth (n,) of the same pixels; a predicted depth may be infinite."""
PixelPieces = Callable[[], Iterable[Pixels]]
"""Gives the same pixels, piece by piece, each time it is called."""

ALIGNMENT_WORDS: dict[AlignmentKind, str] = {
    "none": "none: predicted depth is taken as it is",
    "scale": "one factor, median(true) / median(predicted)",
    "scale_shift": "robust scale and shift of depth: medians, and mean absolute deviations from them, are made equal",
    "affine_disparity": "scale and shift of disparity by least squares against 1 / true depth",
}
_VDA_EPSILON = 1e-8
"""Added to true depth before it is inverted, as the benchmark of Video Depth Anything does."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """``depth -> scale * depth + shift``, or the same of disparity."""

    scale: float = 1.0
    shift: float = 0.0
    of_disparity: bool = False
    lengths: tuple[float, float, float, float] | None = None
    """What robust scale and shift make equal: median and mean absolute deviation of truth, then of prediction."""

    def depth(self, predicted: NDArray[np.floating]) -> NDArray[np.float64]:
        """Aligned depth of predicted depth, of any shape.

        It may be negative after a shift, and is infinite where aligned disparity is not positive: it is meant to be
        clipped to the caps.
        """
        values = np.asarray(predicted, np.float64)
        if not self.of_disparity:
            return self.scale * values + self.shift
        with np.errstate(divide="ignore"):
            disparity = self.scale / values + self.shift
            return np.where(disparity > 0, 1.0 / np.where(disparity > 0, disparity, 1.0), np.inf)


def fit_alignment(kind: AlignmentKind, pieces: PixelPieces) -> Alignment:
    """The alignment of one kind that fits all pieces together.

    Raises:
        GeometryError: If there is no pixel, or the prediction cannot be scaled (nothing positive, or all the same
            where a shift is wanted).
    """
    if kind == "none":
        return Alignment()
    if kind == "scale":
        return _scale(pieces)
    return _scale_shift(pieces) if kind == "scale_shift" else _affine_disparity(pieces)


def _scale(pieces: PixelPieces) -> Alignment:
    true, predicted = _medians(pieces, deviation=False)
    ratio = true.median() / predicted.median() if predicted.median() > 0 else float("nan")
    if not (np.isfinite(ratio) and ratio > 0):
        raise GeometryError(f"median scaling needs positive depth, got medians {true.median()}, {predicted.median()}")
    return Alignment(scale=ratio)


def _scale_shift(pieces: PixelPieces) -> Alignment:
    true, predicted = _medians(pieces, deviation=True)
    spread = predicted.mean_absolute_deviation()
    if not (np.isfinite(spread) and spread > 0):
        raise GeometryError("scale and shift need predicted depth that is finite and differs; use scale alone")
    lengths = (true.median(), true.mean_absolute_deviation(), predicted.median(), spread)
    scale = lengths[1] / spread
    return Alignment(scale=scale, shift=lengths[0] - scale * lengths[2], lengths=lengths)


def _affine_disparity(pieces: PixelPieces) -> Alignment:
    sums = np.zeros(5)
    for true, predicted in pieces():
        y = 1.0 / (np.asarray(true, np.float64) + _VDA_EPSILON)
        x = 1.0 / np.asarray(predicted, np.float64)
        sums += np.array([len(x), x.sum(), y.sum(), x @ x, x @ y], np.float64)
    n, sum_x, sum_y, xx, xy = (float(value) for value in sums)
    spread = n * xx - sum_x * sum_x
    if n == 0 or not spread > 1e-12 * n * xx:
        raise GeometryError(f"a fit in disparity needs predictions that differ; {int(n)} pixels have one value or none")
    scale = (n * xy - sum_x * sum_y) / spread
    return Alignment(scale=scale, shift=(sum_y - scale * sum_x) / n, of_disparity=True)


def _medians(pieces: PixelPieces, *, deviation: bool) -> tuple[StreamingMedian, StreamingMedian]:
    """Of truth and prediction, in two passes over both."""
    true, predicted = StreamingMedian(deviation=deviation), StreamingMedian(deviation=deviation)
    for g, p in pieces():
        true.coarse(g)
        predicted.coarse(p)
    for g, p in pieces():
        true.fine(g)
        predicted.fine(p)
    return true, predicted

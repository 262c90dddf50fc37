"""Depth errors of one frame, and their mean over a clip.

The seven numbers of Eigen et al. (NIPS 2014), as the endoscopy papers report them: computed over the pixels of one
frame, then averaged over frames, so that the RMSE of a clip is a mean of RMSEs and not a pooled one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError

_DELTA = 1.25
"""A prediction within this factor of the truth counts for delta1; its square and cube for delta2 and delta3."""


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Errors of aligned depth; all NaN where there was no pixel."""

    abs_rel: float
    """mean |g - p| / g"""
    sq_rel: float
    """mean (g - p)^2 / g, in the unit of depth"""
    rmse: float
    """root of mean (g - p)^2, in the unit of depth"""
    rmse_log: float
    """root of mean (ln g - ln p)^2"""
    delta1: float
    """share of pixels with max(g / p, p / g) < 1.25"""
    delta2: float
    """share below 1.25^2"""
    delta3: float
    """share below 1.25^3"""

    def as_dict(self) -> dict[str, float]:
        """The numbers by name."""
        return asdict(self)


NAMES = tuple(field.name for field in fields(DepthErrors))
UNITS_OF_DEPTH = ("sq_rel", "rmse")
"""The numbers that carry the unit of depth, and so must not be averaged over data sets of different units."""


def depth_errors(truth: NDArray[np.floating], predicted: NDArray[np.floating]) -> DepthErrors:
    """Errors over the pixels of one frame.

    Args:
        truth: Positive depths (n,).
        predicted: Positive depths (n,) of the same pixels, aligned.

    Returns:
        The errors; all NaN if there is no pixel, so that a mean over frames can leave the frame out.

    Raises:
        GeometryError: If the shapes differ or a depth is not positive and finite.
    """
    g, p = np.asarray(truth, np.float64), np.asarray(predicted, np.float64)
    if g.shape != p.shape or g.ndim != 1:
        raise GeometryError(f"depth errors need two lists of equal length, got shapes {g.shape} and {p.shape}")
    for name, values in (("true", g), ("predicted", p)):
        if not (np.isfinite(values).all() and (values > 0).all()):
            raise GeometryError(
                f"{name} depth holds values that are not positive and finite; select valid pixels first"
            )
    if g.size == 0:
        return DepthErrors(*(float("nan"),) * len(NAMES))
    difference = g - p
    squared = difference * difference
    quotient = g / p
    ratio = np.maximum(quotient, 1.0 / quotient)
    log_ratio = np.log(quotient)
    return DepthErrors(
        abs_rel=float(np.mean(np.abs(difference) / g)),
        sq_rel=float(np.mean(squared / g)),
        rmse=float(np.sqrt(np.mean(squared))),
        rmse_log=float(np.sqrt(np.mean(log_ratio * log_ratio))),
        delta1=float(np.mean(ratio < _DELTA)),
        delta2=float(np.mean(ratio < _DELTA**2)),
        delta3=float(np.mean(ratio < _DELTA**3)),
    )


def mean_errors(frames: Sequence[DepthErrors]) -> DepthErrors:
    """Mean over frames; frames without a pixel (all NaN) are left out, and all NaN if none is left."""
    table = np.array([list(frame.as_dict().values()) for frame in frames], np.float64).reshape(-1, len(NAMES))
    table = table[~np.isnan(table).all(axis=1)]
    means = table.mean(axis=0) if len(table) else np.full(len(NAMES), np.nan)
    return DepthErrors(*(float(value) for value in means))

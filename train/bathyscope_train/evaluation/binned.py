"""Errors against true depth: sums in bins a quarter of an octave wide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64

_BITS = 21
"""Mantissa bits of float32 below the two that split an octave into four."""
_BINS = 1 << (31 - _BITS)


@dataclass
class BinnedErrors:
    """Per bin of true depth: pixels, and sums of relative errors with and without sign."""

    counts: F64
    absolute: F64
    signed: F64

    @classmethod
    def empty(cls) -> BinnedErrors:
        """Nothing seen."""
        return cls(np.zeros(_BINS), np.zeros(_BINS), np.zeros(_BINS))

    def add(self, true: NDArray[np.floating], aligned: NDArray[np.floating]) -> None:
        """Pixels (n,) of positive true depth and aligned prediction."""
        g = np.asarray(true, np.float32)
        bins = np.ascontiguousarray(g).view(np.uint32) >> _BITS
        relative = np.asarray(aligned, np.float64) / g - 1.0
        self.counts += np.bincount(bins, minlength=_BINS)
        self.absolute += np.bincount(bins, weights=np.abs(relative), minlength=_BINS)
        self.signed += np.bincount(bins, weights=relative, minlength=_BINS)

    def __add__(self, other: BinnedErrors) -> BinnedErrors:
        return BinnedErrors(self.counts + other.counts, self.absolute + other.absolute, self.signed + other.signed)

    def curve(self, least: float = 1e-3) -> tuple[F64, F64, F64]:
        """Depth in the middle of a bin, mean absolute and mean signed relative error there.

        Args:
            least: Bins with a smaller share of all pixels are left out.
        """
        keep = self.counts > least * self.counts.sum()
        bins = np.flatnonzero(keep)
        low, high = ((np.asarray(b, np.uint32) << _BITS).view(np.float32).astype(np.float64) for b in (bins, bins + 1))
        n = self.counts[keep]
        return (low + high) / 2, self.absolute[keep] / n, self.signed[keep] / n

    def as_dict(self) -> dict[str, list[float]]:
        """For JSON: only bins that hold pixels."""
        bins = np.flatnonzero(self.counts)
        return {
            "bin": bins.tolist(),
            "pixels": self.counts[bins].tolist(),
            "absolute": self.absolute[bins].tolist(),
            "signed": self.signed[bins].tolist(),
        }

    @classmethod
    def from_dict(cls, stored: dict[str, list[float]]) -> BinnedErrors:
        """The other way round."""
        found = cls.empty()
        bins = np.asarray(stored["bin"], np.intp)
        for name, array in (("pixels", found.counts), ("absolute", found.absolute), ("signed", found.signed)):
            array[bins] = stored[name]
        return found

"""Exact medians of more numbers than fit into memory: a radix search over the bits of float32, in two passes.

The first pass counts values by the upper half of their bits, which says where the middle ones are; the second counts
the lower half inside those two bins. Bits of floats are ordered like the floats once the sign is dealt with, so the
answer is the median itself and not an estimate of it. Sums kept for each bin make the mean absolute deviation from
the median exact too, without a third pass.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import GeometryError

_HALF = 1 << 16
_SIGN = np.uint32(1 << 31)


class StreamingMedian:
    """Median and mean absolute deviation from it; call ``coarse`` on every piece, then ``fine`` on every piece."""

    def __init__(self, *, deviation: bool = True) -> None:
        """Begin; without ``deviation`` the median alone is kept, which is quicker."""
        self._counts = np.zeros(_HALF, np.int64)
        self._deviation = deviation
        self._sums = np.zeros(_HALF)
        self._lower: dict[int, NDArray[np.int64]] = {}

    @property
    def count(self) -> int:
        """Values seen in the first pass."""
        return int(self._counts.sum())

    def coarse(self, values: NDArray[np.floating]) -> None:
        """First pass.

        Raises:
            GeometryError: If a value is NaN.
        """
        piece = np.ravel(np.asarray(values, np.float32))
        if np.isnan(piece).any():
            raise GeometryError("a median needs numbers; one of the values is NaN, select valid pixels first")
        upper = _sortable(piece) >> 16
        self._counts += np.bincount(upper, minlength=_HALF)
        if self._deviation:
            self._sums += np.bincount(upper, weights=piece, minlength=_HALF)

    def fine(self, values: NDArray[np.floating]) -> None:
        """Second pass, over the same values."""
        if not self._lower:
            self._lower = {bin_: np.zeros(_HALF, np.int64) for bin_ in {self._bin(rank)[0] for rank in self._ranks()}}
        bits = _sortable(np.ravel(np.asarray(values, np.float32)))
        for bin_ in self._lower:
            self._lower[bin_] += np.bincount(bits[bits >> 16 == bin_] & 0xFFFF, minlength=_HALF)

    def median(self) -> float:
        """As ``numpy.median`` of all values, in float32: the mean of the two middle ones where their number is even.

        Raises:
            GeometryError: If there was no value.
        """
        middle = np.array([self._value(rank) for rank in self._ranks()], np.float32)
        return float(middle.mean())

    def mean_absolute_deviation(self) -> float:
        """Mean of ``|x - median|``.

        Raises:
            GeometryError: If there was no value.
        """
        assert self._deviation, "the deviation was not asked for"
        median = self.median()
        total = 0.0
        below = np.arange(_HALF) < min(self._lower)
        for bin_, counts in self._lower.items():
            total += float(np.abs(_floats(bin_) - median)[counts > 0] @ counts[counts > 0])
        for side, sign in ((below, -1.0), (~below, 1.0)):
            others = side.copy()
            others[list(self._lower)] = False
            total += sign * float(self._sums[others].sum() - median * self._counts[others].sum())
        return total / self.count

    def _ranks(self) -> tuple[int, int]:
        if self.count == 0:
            raise GeometryError("a median needs at least one value, got none")
        return (self.count - 1) // 2, self.count // 2

    def _bin(self, rank: int) -> tuple[int, int]:
        """The bin that holds a rank, and how many values lie in bins before it."""
        ends = np.cumsum(self._counts)
        bin_ = int(np.searchsorted(ends, rank, side="right"))
        return bin_, int(ends[bin_] - self._counts[bin_])

    def _value(self, rank: int) -> np.float32:
        bin_, before = self._bin(rank)
        lower = int(np.searchsorted(np.cumsum(self._lower[bin_]), rank - before, side="right"))
        return np.float32(_floats(bin_)[lower])


def _sortable(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Unsigned integers in the order of the floats."""
    bits = np.ascontiguousarray(values).view(np.uint32)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _floats(bin_: int) -> NDArray[np.float64]:
    """The float32 values (65536,) whose sortable integers begin with the bits of a bin."""
    keys = (np.uint32(bin_) << np.uint32(16)) | np.arange(_HALF, dtype=np.uint32)
    bits = np.where(keys & _SIGN, keys & ~_SIGN, ~keys).astype(np.uint32)
    with np.errstate(invalid="ignore"):
        return bits.view(np.float32).astype(np.float64)

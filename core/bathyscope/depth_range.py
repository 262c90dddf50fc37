"""Disparity between two depths: what the values of EndoDAC's and EndoDAV's networks mean."""

from __future__ import annotations

from typing import Any, TypeVar, cast

from pydantic import BaseModel, PositiveFloat

Values = TypeVar("Values")


class DepthRange(BaseModel, frozen=True, extra="forbid"):
    """The depths, in the network's own unit, that a disparity of 1 and of 0 stand for; the defaults are published.

    Takes and gives arrays or tensors of any shape.
    """

    nearest: PositiveFloat = 0.1
    farthest: PositiveFloat = 150.0

    def scaled(self, disparity: Values) -> Values:
        """Inverse depth: ``1 / farthest + (1 / nearest - 1 / farthest) * disparity``.

        A disparity above 1, which networks without a sigmoid give, lies nearer than ``nearest``.
        """
        low, high = 1 / self.farthest, 1 / self.nearest
        values: Any = disparity
        return cast(Values, low + (high - low) * values)

    def depth(self, disparity: Values) -> Values:
        """Depth of a network disparity: one over :meth:`scaled`."""
        inverse: Any = self.scaled(disparity)
        return cast(Values, 1 / inverse)

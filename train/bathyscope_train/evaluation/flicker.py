r"""Flicker without poses and without truth: how much log depth at a pixel jerks from frame to frame.

.. math:: \text{flicker} = 100\;\mathrm{mean}\,\big|\ln d_{t-1} - 2 \ln d_t + \ln d_{t+1}\big|

A camera that moves evenly changes depth evenly, which a second difference does not see; what remains is depth that
goes back and forth. One factor for the whole clip does not change it, so it needs no alignment. Edges that move across
a pixel do count: compare it between systems on the same clip, or with the flicker of the true depth, not with zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def flicker(
    before: NDArray[np.floating], now: NDArray[np.floating], after: NDArray[np.floating], mask: NDArray[np.bool_]
) -> float:
    """Flicker of three consecutive frames, in per cent; NaN where no pixel counts.

    Args:
        before: Depth (h, w) of the frame before; not aligned is as good.
        now: Of the frame itself.
        after: Of the frame after.
        mask: (h, w) pixels that have positive, finite depth in all three.
    """
    if not mask.any():
        return float("nan")
    a, b, c = (np.asarray(depth[mask], np.float64) for depth in (before, now, after))
    return float(100.0 * np.mean(np.abs(np.log(a * c / (b * b)))))

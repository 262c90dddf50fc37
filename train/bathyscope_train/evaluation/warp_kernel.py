"""Points of one depth map in the pixels of another camera, compiled: every pixel of every frame is visited twice."""

from __future__ import annotations

from typing import Any

import numpy as np

from bathyscope.splat.jit import kernel

IN_FRONT = 1e-6


@kernel
def scatter(  # noqa: PLR0917
    depth: Any, mask: Any, turn: Any, shift: Any, centre: Any, rounded: Any, nearest_wins: Any, landed: Any
) -> None:
    """Write the depth of every point into the pixel it lands in.

    Args:
        depth: (h, w) float64, in scan order.
        mask: (h, w) bool, points that count.
        turn: (3, 3) from homogeneous pixels times depth to those of the other camera.
        shift: (3,) added to them.
        centre: Where a pixel's centre lies in it.
        rounded: Round half to even without removing ``centre``; otherwise take the pixel it falls into.
        nearest_wins: Of several points keep the nearest; otherwise the last.
        landed: (h, w) float64 zeros, written.
    """
    h, w = depth.shape
    for row in range(h):
        for column in range(w):
            if not mask[row, column]:
                continue
            d = depth[row, column]
            x, y = (column + centre) * d, (row + centre) * d
            z = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * d + shift[2]
            if not z > IN_FRONT:
                continue
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * d + shift[0]) / z
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * d + shift[1]) / z
            if rounded:
                u, v = np.rint(u), np.rint(v)
            else:
                u, v = np.floor(u + 0.5 - centre), np.floor(v + 0.5 - centre)
            if u >= 0 and u < w and v >= 0 and v < h:
                there = landed[int(v), int(u)]
                if not nearest_wins or there == 0.0 or z < there:
                    landed[int(v), int(u)] = z


@kernel
def disagreement(landed: Any, depth: Any, mask: Any, within: Any) -> tuple[float, int, int]:
    """Compare where a point landed and ``mask`` holds.

    Args:
        landed: (h, w) depth that is expected; 0 where none.
        depth: (h, w) depth that is observed.
        mask: (h, w) bool.
        within: Largest ratio that still counts as agreement, itself excluded.

    Returns:
        Sum of |observed - expected| / observed, how many pixels agree, and how many were compared.
    """
    total, agree, count = 0.0, 0, 0
    h, w = depth.shape
    for row in range(h):
        for column in range(w):
            expected = landed[row, column]
            if not mask[row, column] or not expected > IN_FRONT:
                continue
            observed = depth[row, column]
            total += abs(observed - expected) / observed
            agree += max(observed / expected, expected / observed) < within
            count += 1
    return total, agree, count

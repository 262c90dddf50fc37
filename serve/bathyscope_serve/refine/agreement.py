"""How far a network's depth is from points that were followed: what can be said of its error without ground truth.

Only points count that were seen from sides far enough apart for their rays alone to say how far away they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bathyscope.result import PointAgreement
from bathyscope_serve.refine.depth_field import KnownDepths

_CERTAIN = 0.05
"""Largest standard deviation of a point's log depth."""
_LEAST = 20
"""Points of a frame."""


class FrameAgreement(NamedTuple):
    """One frame's."""

    difference: float
    """Mean of abs(depth of the frame / depth of the point - 1), at most 1 each, with the frame's median taken out."""
    points: int


def frame_agreement(known: KnownDepths) -> FrameAgreement | None:
    """How far a frame's own depth is from its points; ``None`` if too few are certain."""
    certain = known.doubt < _CERTAIN
    if certain.sum() < _LEAST:
        return None
    ratio = known.own[certain] - known.found[certain]
    off = np.abs(np.expm1(ratio - np.median(ratio)))
    return FrameAgreement(float(np.minimum(off, 1.0).mean()), int(certain.sum()))


def clip_agreement(frames: list[FrameAgreement]) -> PointAgreement | None:
    """All frames of a clip that can say something; ``None`` if there are none."""
    if not frames:
        return None
    difference, points = (float(np.mean(values)) for values in zip(*frames, strict=True))
    return PointAgreement(difference=round(difference, 4), points=round(points, 1), frames=len(frames))

"""One colour range for a clip: near is warm, far is cold, nothing is black."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.result import FrameDepth

_SAMPLES_PER_FRAME = 2000
_KEPT_SAMPLES = 1 << 20
_FARTHEST = 1e-6
"""Disparity is not taken below this."""
_COLDEST, _WARMEST = 24, 236
"""Levels of the colour map that are used: its ends are nearly black, which stands for nothing here."""


@dataclass(frozen=True, slots=True)
class ClipRange:
    """What is usual in a clip, from a sample of its valid pixels."""

    near: float
    """2nd percentile of depth."""
    far: float
    """98th percentile of depth."""
    sure: float
    """30th percentile of confidence: a third of the pixels are less sure. 0 from a network that gives none."""
    frames: int
    longest_segment: int
    """The segment with most frames; frames of other segments lie in worlds of their own."""
    segments: int
    disparity: bool = False
    """Whether the clip holds disparity; ``near`` and ``far`` then are of its inverse."""


def measure_range(frames: Iterable[FrameDepth], *, disparity: bool = False) -> ClipRange:
    """Read a clip once, keeping at most a million samples of it.

    Args:
        frames: The clip.
        disparity: Whether it holds disparity instead of depth.
    """
    depths: list[NDArray[np.float32]] = []
    confidences: list[NDArray[np.float32]] = []
    segments: dict[int, int] = {}
    thinning = 1
    for number, frame in enumerate(frames):
        segments[frame.segment] = segments.get(frame.segment, 0) + 1
        if number % thinning:
            continue
        picked = np.flatnonzero(frame.valid)
        picked = picked[:: max(1, len(picked) // _SAMPLES_PER_FRAME)]
        values = frame.depth.ravel()[picked].astype(np.float32)
        depths.append(inverse(values) if disparity else values)
        if frame.confidence is not None:
            confidences.append(frame.confidence.ravel()[picked].astype(np.float32))
        if len(depths) * _SAMPLES_PER_FRAME > _KEPT_SAMPLES:
            depths, confidences, thinning = depths[::2], confidences[::2], 2 * thinning
    depth = np.concatenate(depths) if depths else np.zeros(0, np.float32)
    confidence = np.concatenate(confidences) if confidences else np.zeros(0, np.float32)
    near, far = np.percentile(depth, (2, 98)) if depth.size else (1.0, 1.0)
    return ClipRange(
        near=float(near),
        far=float(far),
        sure=float(np.percentile(confidence, 30)) if confidence.size else 0.0,
        frames=sum(segments.values()),
        longest_segment=max(segments, key=lambda segment: segments[segment], default=0),
        segments=len(segments),
        disparity=disparity,
    )


def inverse(disparity: NDArray[np.floating]) -> NDArray[np.float32]:
    """Depth of disparity, for pictures: right in order, not in shape, where the disparity has an unknown shift."""
    return np.asarray(1.0 / np.maximum(disparity.astype(np.float32), _FARTHEST), np.float32)


def colour_depth(depth: NDArray[np.floating], valid: NDArray[np.bool_], span: ClipRange) -> NDArray[np.uint8]:
    """RGB picture (h, w, 3) of depth or disparity, logarithmic from ``span.near`` (red) to ``span.far`` (blue)."""
    near = max(span.near, 1e-12)
    width = max(np.log(max(span.far, near) / near), 1e-6)
    depth = inverse(depth) if span.disparity else depth
    logs = np.log(np.maximum(depth.astype(np.float32), 1e-12) / near) / width
    levels = np.rint(_COLDEST + (_WARMEST - _COLDEST) * np.clip(1.0 - logs, 0.0, 1.0)).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1], np.uint8)
    return np.where(valid[..., None], coloured, np.uint8(0))

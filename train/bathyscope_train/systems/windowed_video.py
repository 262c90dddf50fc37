"""Systems that give one map a frame, window by window: read, resize, run, resize back, stitch, hand out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.affine_stitch import AffineStitcher
from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope.keyed_windows import KeyedWindows, keyed_windows
from bathyscope.resizing import resize_corners
from bathyscope_train.systems.system import F32, FrameEstimate, SystemInfo


@dataclass(frozen=True)
class WindowedVideoSystem:
    """A network that sees a window of frames at once, and knows no cameras.

    Memory holds the inputs of one window and the maps of two, whatever the length of the clip.
    """

    info: SystemInfo
    rule: KeyedWindows
    prepare: Callable[[NDArray[np.uint8]], F32]
    """A frame (H, W, 3) to the network's input (3, h, w)."""
    predict: Callable[[F32], F32]
    """Inputs (n, 3, h, w) of a window to values (n, h, w)."""

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`; intrinsics are of no use to it."""
        everywhere = np.ones(frames.size, np.bool_)
        for index, values in enumerate(self._stitched(frames)):
            yield FrameEstimate(index, values, everywhere)

    def _stitched(self, frames: FrameSequence) -> Iterator[F32]:
        stitcher = AffineStitcher(self.rule)
        inputs = (self.prepare(frames.image(index)) for index in range(len(frames)))
        for window in keyed_windows(inputs, self.rule):
            values = resize_corners(self.predict(np.stack(window.items)), frames.size)
            yield from stitcher.add(values, window.fresh)
        yield from stitcher.finish()

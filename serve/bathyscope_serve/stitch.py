"""Bring the windows of a video into one world for each segment, and hand out frames as they become final.

Windows are scaled by the depth that shared frames have by themselves. Rendered depth leans towards the rest of its
window: at the end of one to what came before, at the start of the next to what comes after. Scaled by it, windows of
a camera that keeps advancing would shrink one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Similarity, invert_pose
from bathyscope_serve.alignment import Misfit, SharedFrames, align, blend_poses
from bathyscope_serve.engine_settings import StitchSettings

F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SmallDepth:
    """One frame at the network's size."""

    index: int
    """Number of the frame in the source."""
    timestamp_s: float
    depth: F32
    """(h, w)"""
    confidence: F32
    """(h, w)"""
    known: NDArray[np.bool_]
    """(h, w) where depth and confidence mean something."""
    world_from_camera: F64
    """(4, 4)"""
    intrinsics: F64
    """(3, 3) in pixels of the network's image."""
    single: F32 | None = None
    """(h, w) depth as the frame has it by itself, which windows are scaled by; ``depth`` unless given."""
    segment: int = 0

    def moved(self, motion: Similarity, segment: int) -> SmallDepth:
        """The frame in another world."""
        return replace(
            self,
            depth=(self.depth * np.float32(motion.scale)).astype(np.float32),
            single=None if self.single is None else (self.single * np.float32(motion.scale)).astype(np.float32),
            world_from_camera=motion.poses(self.world_from_camera),
            segment=segment,
        )


class Stitcher:
    """Takes windows in order; each camera and depth it gives out lies in the world of its segment's first frame.

    Args:
        overlap: Frames that regular windows share; what lies further back is final.
        settings: When an alignment is believed.
    """

    def __init__(self, overlap: int, settings: StitchSettings) -> None:
        self._overlap = overlap
        self._settings = settings
        self._segment = -1
        self._window: dict[int, SmallDepth] = {}
        self._given = -1
        self.warnings: list[str] = []

    def add(self, window: list[SmallDepth], shared: int) -> Iterator[SmallDepth]:
        """Add a window; gives the frames that are final now.

        Args:
            window: Frames in the window's own world, in which its first camera is the identity.
            shared: Leading frames that the window before held too; 0 begins a segment.
        """
        motion: Similarity | Misfit
        if shared == 0:
            motion = Misfit("")
            if self._segment >= 0:
                self.warnings.append(f"a cut at frame {window[0].index}: what follows has a world and scale of its own")
        else:
            motion = self._align(window[:shared])
            if isinstance(motion, Misfit):
                self.warnings.append(
                    f"frames from {window[shared].index} on have a world and scale of their own: {motion.reason}"
                )
        if isinstance(motion, Misfit):
            yield from self.finish()
            self._begin(window[shared:])
        else:
            self._join(window, motion)
        yield from self._give(len(self._window) - self._overlap)

    def finish(self) -> Iterator[SmallDepth]:
        """Everything that is left."""
        yield from self._give(len(self._window))

    def _align(self, window: list[SmallDepth]) -> Similarity | Misfit:
        pairs = [(self._window[frame.index], frame) for frame in window if frame.index in self._window]
        if not pairs:
            return Misfit("no frame is shared with what came before")
        target, source = zip(*pairs, strict=True)
        return align(_together(target), _together(source), self._settings)

    def _begin(self, window: list[SmallDepth]) -> None:
        """Start a segment whose first camera is the identity."""
        self._segment += 1
        first = invert_pose(window[0].world_from_camera)
        motion = Similarity(1.0, first[:3, :3], first[:3, 3])
        moved = [frame.moved(motion, self._segment) for frame in window]
        moved[0] = replace(moved[0], world_from_camera=np.eye(4))
        self._window = {frame.index: frame for frame in moved}

    def _join(self, window: list[SmallDepth], motion: Similarity) -> None:
        """Carry a window over, blending into it the frames that are not given out yet; given ones stay as they are."""
        moved = {frame.index: frame.moved(motion, self._segment) for frame in window}
        open_frames = [index for index in moved if index in self._window and index > self._given]
        for place, index in enumerate(open_frames):
            moved[index] = blend(self._window[index], moved[index], (place + 1) / (len(open_frames) + 1))
        for index in moved:
            if index in self._window and index <= self._given:
                moved[index] = self._window[index]
        self._window = moved

    def _give(self, count: int) -> Iterator[SmallDepth]:
        for index in list(self._window)[: max(0, count)]:
            if index > self._given:
                self._given = index
                yield self._window[index]


def blend(first: SmallDepth, second: SmallDepth, share: float) -> SmallDepth:
    """One frame from two windows in the same world; where only one knows a pixel, its value counts alone."""
    a = np.where(first.known, np.float32(1 - share), 0)
    b = np.where(second.known, np.float32(share), 0)
    total = np.maximum(a + b, np.float32(1e-12))
    return replace(
        second,
        depth=((a * first.depth + b * second.depth) / total).astype(np.float32),
        confidence=((a * first.confidence + b * second.confidence) / total).astype(np.float32),
        known=first.known | second.known,
        world_from_camera=blend_poses(first.world_from_camera, second.world_from_camera, share),
        intrinsics=(1 - share) * first.intrinsics + share * second.intrinsics,
    )


def _together(frames: tuple[SmallDepth, ...]) -> SharedFrames:
    return SharedFrames(
        np.stack([frame.depth if frame.single is None else frame.single for frame in frames]),
        np.stack([frame.known for frame in frames]),
        np.stack([frame.world_from_camera for frame in frames]),
    )

"""Bring the windows of a video into one world for each segment, and hand out frames as they become final.

Windows are scaled by the depth that shared frames have by themselves, and rendered only when they have been placed.
Rendered depth leans towards the rest of its window: at the end of one to what came before, at the start of the next to
what comes after. Scaled by it, windows of a camera that keeps advancing would shrink one after the other.

The windows of a block (:mod:`.blocks`) hang on its first one; frames that two blocks share are blended.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bathyscope.camera import Similarity, invert_pose
from bathyscope_serve.alignment import Misfit, SharedFrames, align, blend_poses
from bathyscope_serve.engine_settings import StitchSettings
from bathyscope_serve.placed import PlacedFrame


class Stitcher:
    """Takes windows; each camera and depth it gives out lies in the world of its segment's first frame.

    Args:
        settings: When an alignment is believed.
    """

    def __init__(self, settings: StitchSettings) -> None:
        self._settings = settings
        self._segment = 0
        self._known: dict[int, PlacedFrame] = {}
        """Frames of the segment, by number: those that are open, and those that the last windows held."""
        self._ended: list[PlacedFrame] = []
        """Open frames of segments that have ended."""
        self._given = -1
        self.warnings: list[str] = []

    def cut(self, index: int) -> None:
        """Another shot begins with the frame of this number."""
        if self._known:
            self.warnings.append(f"a cut at frame {index}: what follows has a world and scale of its own")
            self._end_segment()

    def weave(self, windows: Iterable[list[PlacedFrame]]) -> bool:
        """Add the windows of a block: the first shares frames with what came before, the others share some with it.

        Returns:
            Whether all of them fit; if not, nothing has been added.
        """
        woven: dict[int, PlacedFrame] = {}
        for window in windows:
            if woven:
                motion = self._align(window, woven, between=True)
                if isinstance(motion, Misfit):
                    return False
                woven |= {f.index: f.moved(motion, self._segment) for f in window if f.index not in woven}
            elif self._known:
                motion = self._align(window, self._known)
                if isinstance(motion, Misfit):
                    return False
                woven = self._joined(window, motion)
            else:
                woven = self._begun(window)
        self._keep(woven)
        return True

    def add(self, window: list[PlacedFrame]) -> None:
        """Add a window of neighbours; where it does not fit, its new frames begin a segment."""
        if not self._known:
            self._keep(self._begun(window))
            return
        motion = self._align(window, self._known)
        if isinstance(motion, Misfit):
            newest = max(self._known)
            fresh = [frame for frame in window if frame.index > newest]
            self.warnings.append(
                f"frames from {fresh[0].index} on have a world and scale of their own: {motion.reason}"
            )
            self._end_segment()
            self._keep(self._begun(fresh))
        else:
            self._keep(self._joined(window, motion))

    def take(self, before: int | None = None) -> list[PlacedFrame]:
        """Frames that have become final, in order: those with numbers below ``before``, and all of ended segments."""
        final = self._ended + [
            frame
            for index, frame in sorted(self._known.items())
            if index > self._given and (before is None or index < before)
        ]
        self._ended = []
        if final:
            self._given = final[-1].index
        return final

    def _align(
        self, window: list[PlacedFrame], known: dict[int, PlacedFrame], *, between: bool = False
    ) -> Similarity | Misfit:
        """From the window to what is known, by the frames that both hold.

        With ``between``, the cameras of the window's other frames are expected between their known neighbours. A camera
        that trembles is not there, but the tremor of several frames averages out, and what is left is the window's
        own error.
        """
        pairs = [(known[frame.index], frame) for frame in window if frame.index in known]
        if not pairs:
            return Misfit("no frame is shared with what came before")
        if between:
            pairs += [(_expected(frame, known), frame) for frame in window if frame.index not in known]
        target, source = zip(*pairs, strict=True)
        return align(_together(target), _together(source), self._settings)

    def _begun(self, window: list[PlacedFrame]) -> dict[int, PlacedFrame]:
        """The window in a world of its own, whose first camera is the identity."""
        first = invert_pose(window[0].world_from_camera)
        motion = Similarity(1.0, first[:3, :3], first[:3, 3])
        moved = {frame.index: frame.moved(motion, self._segment) for frame in window}
        moved[window[0].index] = replace(moved[window[0].index], world_from_camera=np.eye(4))
        return moved

    def _joined(self, window: list[PlacedFrame], motion: Similarity) -> dict[int, PlacedFrame]:
        """The window carried over, what is open blended from the frames as they were; given ones stay as they are."""
        moved = {frame.index: frame.moved(motion, self._segment) for frame in window}
        both = [index for index in moved if index in self._known]
        open_frames = [index for index in both if index > self._given]
        for place, index in enumerate(open_frames):
            moved[index] = blend(self._known[index], moved[index], (place + 1) / (len(open_frames) + 1))
        return moved | {index: self._known[index] for index in both if index <= self._given}

    def _keep(self, frames: dict[int, PlacedFrame]) -> None:
        self._known = {index: frame for index, frame in self._known.items() if index > self._given} | frames

    def _end_segment(self) -> None:
        self._ended += [frame for index, frame in sorted(self._known.items()) if index > self._given]
        self._known = {}
        self._segment += 1


def blend(first: PlacedFrame, second: PlacedFrame, share: float) -> PlacedFrame:
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


def _expected(frame: PlacedFrame, known: dict[int, PlacedFrame]) -> PlacedFrame:
    """A frame with its camera on the way between its neighbours in time, and without depth."""
    before = max(index for index in known if index < frame.index)
    after = min(index for index in known if index > frame.index)
    share = (frame.index - before) / (after - before)
    pose = blend_poses(known[before].world_from_camera, known[after].world_from_camera, share)
    return replace(frame, world_from_camera=pose, known=np.zeros_like(frame.known))


def _together(frames: tuple[PlacedFrame, ...]) -> SharedFrames:
    return SharedFrames(
        np.stack([frame.depth for frame in frames]),
        np.stack([frame.known for frame in frames]),
        np.stack([frame.world_from_camera for frame in frames]),
    )

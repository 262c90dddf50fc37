"""Bundle adjustment along a video: frames come in as the windows place them and leave with refined cameras and depth.

Key frames are adjusted a few at a time, together with those before them that have been given out and stay fixed. A
frame is given out when ``wait`` key frames have come after it. The frames between are resected from the points, and the
depth of every frame is corrected by what the points say (:mod:`.depth_field`).

What comes in lies in the world that windows were stitched in. It is carried over by the last key frame that was
adjusted: its camera before and after, and the scale of its depth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bathyscope.camera import F64
from bathyscope.result import PointAgreement
from bathyscope_serve.engine_settings import RefineSettings
from bathyscope_serve.placed import PlacedFrame
from bathyscope_serve.refine.agreement import FrameAgreement, clip_agreement, frame_agreement
from bathyscope_serve.refine.depth_field import LEAST_POINTS, DepthField, fit_field, plain_field
from bathyscope_serve.refine.problem import Problem
from bathyscope_serve.refine.tracked_frame import TrackedFrame, carry, on_the_way, track

_USUAL = 5  # key frames


class Refiner:
    """Takes placed frames in order and gives them back refined.

    Args:
        settings: How many key frames are adjusted together.
    """

    def __init__(self, settings: RefineSettings) -> None:
        self._settings = settings
        self._fixed: list[TrackedFrame] = []
        """Key frames that have been given out."""
        self._open: list[TrackedFrame] = []
        self._fresh = 0
        """Key frames that have come since the last adjustment."""
        self._intrinsics: F64 | None = None
        """Of the segment: a lens does not change, what the windows make of it does."""
        self._scales: list[float] = []
        """Of depth, by the last key frames that were given out and whose points said something about it."""
        self._agreements: list[FrameAgreement] = []

    @property
    def agreement(self) -> PointAgreement | None:
        """How far the depth that came in is from the points, over all frames that have been given out."""
        return clip_agreement(self._agreements)

    def add(self, frames: list[PlacedFrame]) -> list[PlacedFrame]:
        """Frames that have become final."""
        ready = []
        for frame in frames:
            if self._open and self._open[-1].frame.segment != frame.segment:
                ready += self.finish()
            known = self._intrinsics
            self._open.append(self._view(frame if known is None else replace(frame, intrinsics=known)))
            self._fresh += frame.key
            if self._fresh >= self._settings.step:
                ready += self._settle(self._settings.wait)
        return ready

    def finish(self) -> list[PlacedFrame]:
        """What is left of the segment."""
        ready = self._settle(0) if self._open else []
        self._fixed, self._open, self._scales, self._fresh, self._intrinsics = [], [], [], 0, None
        return ready

    def _view(self, frame: PlacedFrame) -> TrackedFrame:
        return track(frame, *self._carried(frame))

    def _carried(self, frame: PlacedFrame) -> tuple[F64, DepthField]:
        """Camera and depth in the refined world, by the key frame before."""
        keys = [view for view in [*self._fixed, *self._open] if view.frame.key and view.shows and view.settled]
        if not keys:
            return frame.world_from_camera, plain_field(1.0)
        scale = _usual([*self._scales, *(view.field.scale for view in self._open if view.frame.key and view.measured)])
        return carry(frame, keys[-1], scale), plain_field(scale)

    def _settle(self, wait: int) -> list[PlacedFrame]:
        """Adjust what is open, and give out all but the last key frames."""
        self._fresh = 0
        if self._intrinsics is None:
            self._intrinsics = _one_lens([view.frame for view in self._open if view.frame.key])
            self._open = [self._view(replace(view.frame, intrinsics=self._intrinsics)) for view in self._open]
        keys = [view for view in self._open if view.frame.key]
        problem = Problem.of(self._fixed[-self._settings.past :], keys)
        if problem is not None:
            problem.solve()
        self._spread(problem)
        end = len(self._open) if wait == 0 else self._open.index(keys[-wait]) if len(keys) > wait else 0
        ready, self._open = self._open[:end], self._open[end:]
        self._agreements += [view.agreement for view in ready if view.agreement is not None]
        self._scales += [view.field.scale for view in ready if view.frame.key and view.measured]
        self._scales = self._scales[-_USUAL:]
        refined = [view.refined() for view in ready]
        self._fixed = [*self._fixed, *(view.without_maps() for view in ready if view.frame.key)]
        self._fixed = self._fixed[-self._settings.past :]
        return refined

    def _spread(self, problem: Problem | None) -> None:
        """To the frames between the key frames, and to every frame's depth."""
        keys = [view for view in self._fixed if view.shows]
        before, scales = keys[-1] if keys else None, [*self._scales]
        field = before.field if before is not None else plain_field(1.0)
        for number, view in enumerate(self._open):
            if view.frame.key and view.shows:
                before = view
            elif problem is not None or not view.shows:
                later = self._open[number + 1 :]
                after = next((other for other in later if other.frame.key and other.shows), None)
                near = on_the_way(view, before, after, _usual(scales))
                view.world_from_camera = near if problem is None else problem.resected(view, near)
            if problem is None:
                continue
            known = problem.known(view)
            field = view.field = fit_field(known, view.size, field.at_scale(_usual(scales)))
            view.measured = len(known.own) >= LEAST_POINTS
            if view.frame.key and view.measured:
                scales.append(view.field.scale)
            view.agreement = frame_agreement(known)
            view.settled = True


def _usual(scales: list[float]) -> float:
    """Of the last of them: one may be that of a blurred frame."""
    return float(np.exp(np.median(np.log(scales[-_USUAL:])))) if scales else 1.0


def _one_lens(frames: list[PlacedFrame]) -> F64:
    """The geometric mean of what the windows say; they agree about the principal point."""
    intrinsics = frames[0].intrinsics.copy()
    for axis in (0, 1):
        intrinsics[axis, axis] = np.exp(np.mean([np.log(frame.intrinsics[axis, axis]) for frame in frames]))
    return intrinsics

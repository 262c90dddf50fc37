"""Temporal numbers of a sequence, from a window of three frames that moves with the measurement."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, invert_pose, scale_intrinsics
from bathyscope_train.evaluation.flicker import flicker
from bathyscope_train.evaluation.frame_pixels import Scene
from bathyscope_train.evaluation.frame_rows import FrameRow
from bathyscope_train.evaluation.protocols import Protocol, Quirk
from bathyscope_train.evaluation.sequences import MILLIMETRES, EvaluationSequence
from bathyscope_train.evaluation.temporal import View, Warping, fixed_intrinsics, temporal_error


@dataclass(frozen=True, slots=True)
class AlignedFrame:
    """One frame as its neighbours see it."""

    index: int
    depth: NDArray[np.float32]
    """(H, W) aligned and clipped prediction."""
    predicted: NDArray[np.bool_]
    true: NDArray[np.float32]
    counts: NDArray[np.bool_]
    """(H, W) where there is truth inside the caps."""


class Neighbours:
    """Fills in TAE, TAS and flicker of rows as frames come in."""

    def __init__(self, sequence: EvaluationSequence, protocol: Protocol, scene: Scene) -> None:
        self._cameras = _cameras(sequence, scene) if protocol.temporal is not None else None
        self._intrinsics = sequence.intrinsics
        self._size = sequence.size
        self._protocol = protocol
        quirks = protocol.quirks
        self._warping = Warping(
            centre=0.0 if Quirk.WHOLE_PIXELS in quirks else 0.5,
            rounded=bool({Quirk.WHOLE_PIXELS, Quirk.SHIFTED_PIXELS} & quirks),
            nearest_wins=Quirk.LAST_POINT not in quirks,
        )
        self._window: deque[AlignedFrame | None] = deque(maxlen=3)

    def add(self, rows: list[FrameRow], frame: AlignedFrame | None) -> None:
        """Take in the frame of the last row, and complete the rows before it.

        Args:
            rows: Of all frames so far; replaced in place.
            frame: ``None`` for a frame without aligned prediction.
        """
        self._window.append(frame)
        if len(self._window) > 1 and (before := self._window[-2]) is not None and frame is not None:
            rows[-2] = self._with_pair(rows[-2], before, frame)
        if len(self._window) == 3:
            first, middle, last = self._window
            if first is not None and middle is not None and last is not None:
                rows[-2] = _with_flicker(rows[-2], (first, middle, last))

    def _with_pair(self, row: FrameRow, a: AlignedFrame, b: AlignedFrame) -> FrameRow:
        fixed = Quirk.FIXED_CAMERA in self._protocol.quirks
        if self._cameras is None or (self._intrinsics is None and not fixed) or a.depth.shape != b.depth.shape:
            return row
        if not np.isfinite(self._cameras[[a.index, b.index]]).all():
            return row
        error = temporal_error(self._view(a, fixed), self._view(b, fixed), self._warping)
        return replace(row, tae=error.tae, tas=error.tas)

    def _view(self, frame: AlignedFrame, fixed: bool) -> View:
        assert self._cameras is not None
        size = (frame.depth.shape[0], frame.depth.shape[1])
        if fixed or self._intrinsics is None:
            intrinsics = fixed_intrinsics(size)
        else:
            intrinsics = scale_intrinsics(self._intrinsics, self._size, size)
        mask = frame.predicted if self._protocol.temporal == "vda" else frame.predicted & frame.counts
        return View(frame.depth, mask, self._cameras[frame.index], intrinsics)


def _cameras(sequence: EvaluationSequence, scene: Scene) -> F64 | None:
    """``camera_from_world`` (t, 4, 4) in the unit of the scene; ``None`` if poses or their unit are not known."""
    poses, unit = sequence.world_from_camera, sequence.pose_unit
    if poses is None or unit is None:
        return None
    arbitrary = 1.0 if unit == "arbitrary" else None
    factor = MILLIMETRES.get(unit) if scene.unit == "mm" else arbitrary
    if factor is None:
        return None
    scaled = np.array(poses, np.float64)
    scaled[:, :3, 3] *= factor
    return invert_pose(scaled)


def _with_flicker(row: FrameRow, window: tuple[AlignedFrame, AlignedFrame, AlignedFrame]) -> FrameRow:
    a, b, c = window
    if not a.depth.shape == b.depth.shape == c.depth.shape:
        return row
    return replace(
        row,
        flicker=flicker(a.depth, b.depth, c.depth, a.predicted & b.predicted & c.predicted),
        true_flicker=flicker(a.true, b.true, c.true, a.counts & b.counts & c.counts),
    )

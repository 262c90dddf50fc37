"""A clip through a video network: one map a frame, windows brought to one scale and shift; no cameras, no scene."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import groupby
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.affine_stitch import AffineStitcher
from bathyscope.camera import Size
from bathyscope.engines import VideoModel
from bathyscope.errors import SettingsError
from bathyscope.keyed_windows import keyed_windows
from bathyscope.model_spec import ModelSpec, ResizeSpec, VideoSpec
from bathyscope.resizing import resize_corners
from bathyscope.result import FrameDepth, ResultMeta
from bathyscope.vision.field_of_view import FieldOfView, Mask
from bathyscope.vision.shorter_side import covering_size, network_size, to_network
from bathyscope_serve.frames import FrameSource
from bathyscope_serve.session import DepthSession, Job, SmallFrame

F32 = NDArray[np.float32]
_SCALES: dict[str, Literal["relative", "mm", "affine"]] = {"relative": "relative", "metric": "mm", "affine": "affine"}
_MILLIMETRES = {"m": 1000.0, "mm": 1.0, None: 1.0}


class VideoSession(DepthSession):
    """A run of a video network.

    The network sees the whole frame, as it was trained to; the field of view only says where its values count. A cut
    begins a new segment, with windows and a scale of its own.

    Args:
        job: What to work on.
        model: The network.
        spec: What it is called, how it is fed and what its values mean.

    Raises:
        SettingsError: If depth is asked for that the network cannot give, or intrinsics are given.
    """

    def __init__(self, job: Job, model: VideoModel, spec: ModelSpec) -> None:
        assert spec.video is not None
        if job.options.depth == "accumulated":
            raise SettingsError(f"{job.bundle.name} renders nothing that could be accumulated; ask for 'head' depth")
        if job.options.intrinsics is not None:
            raise SettingsError(f"{job.bundle.name} has no cameras; it makes no use of intrinsics")
        scale = _SCALES[spec.video.scale]
        super().__init__(job, ResultMeta(depth="head", outputs=spec.outputs, scale=scale))
        self._model, self._video = model, spec.video

    def _estimates(self, source: FrameSource, field_of_view: FieldOfView) -> Iterator[FrameDepth]:
        size = input_size(source.size, self._video.resize, self._job.input.patch)
        inside = cv2.resize(field_of_view.mask.astype(np.uint8), (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
        frames = self._frames(source, partial(to_network, size=size), inside > 0)
        for segment, shot in groupby(self._numbered(frames), key=lambda pair: pair[0]):
            pending: deque[SmallFrame] = deque()
            for values in self._maps(_noting((frame for _, frame in shot), pending), source.size):
                yield self._finished(pending.popleft(), values, field_of_view.mask, segment)

    def _numbered(self, frames: Iterator[tuple[SmallFrame, bool]]) -> Iterator[tuple[int, SmallFrame]]:
        """Frames with the number of their shot."""
        segment = 0
        for number, (frame, cut) in enumerate(frames):
            if cut and number:
                segment += 1
                self._warnings.append(f"a cut at frame {frame.index}: what follows has a scale of its own")
            yield segment, frame

    def _maps(self, frames: Iterator[SmallFrame], size: Size) -> Iterator[F32]:
        """Maps of a shot at the size of the source, as they become final."""
        rule = self._video.windows
        if rule is None:
            for frame in frames:
                yield from self._values((frame,), size)
            return
        stitcher = AffineStitcher(rule)
        for window in keyed_windows(frames, rule):
            values = self._values(window.items, size)
            with self._timed("stitch"):
                final = list(stitcher.add(values, window.fresh))
            yield from final
        yield from stitcher.finish()

    def _values(self, frames: Sequence[SmallFrame], size: Size) -> F32:
        with self._timed("network"):
            values = self._model.values(np.stack([frame.image for frame in frames]), self._checkpoint)
        with self._timed("upsample"):
            enlarged = enlarge(values, size, self._video.resize.back)
        self._checkpoint()
        return enlarged

    def _finished(self, frame: SmallFrame, values: F32, inside: Mask, segment: int) -> FrameDepth:
        depth = meant(values, self._video)
        valid = inside & (depth > 0) if self._video.quantity == "depth" else inside
        return FrameDepth(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            depth=np.where(valid, depth, np.float32(0)),
            confidence=None,
            valid=valid,
            world_from_camera=None,
            intrinsics=None,
            segment=segment,
        )


def input_size(frame: Size, rule: ResizeSpec, patch: int) -> Size:
    """(height, width) that the network sees of frames of size ``frame``."""
    if rule.lower_long:
        return network_size(frame, min(rule.least), patch)
    return covering_size(frame, rule.least, patch)


def enlarge(values: F32, size: Size, back: Literal["corners", "centres"]) -> F32:
    """Maps (n, h, w) at ``size``; see :class:`~bathyscope.model_spec.ResizeSpec`."""
    if back == "corners":
        return resize_corners(values, size)
    resized = [cv2.resize(each, (size[1], size[0]), interpolation=cv2.INTER_LINEAR) for each in values]
    return np.asarray(np.stack(resized), np.float32)


def meant(values: F32, video: VideoSpec) -> F32:
    """What a result holds for a network's values: depth of disparity between two depths, millimetres of metres."""
    depth = values if video.depth_range is None else video.depth_range.depth(values)
    return np.asarray(depth * np.float32(_MILLIMETRES[video.unit]), np.float32)


def _noting(frames: Iterator[SmallFrame], noted: deque[SmallFrame]) -> Iterator[SmallFrame]:
    """The same frames, each noted when it is read."""
    for frame in frames:
        noted.append(frame)
        yield frame

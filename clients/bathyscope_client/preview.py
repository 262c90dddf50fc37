"""``NAME_preview.mp4``: the input beside its depth, at the source's own times."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.result import FrameDepth
from bathyscope_client.depth_colours import ClipRange, colour_depth

_MOST_SIDE = 960
_TICKS = 90_000
"""Of a second: the clock of video time stamps."""


class PreviewWriter:
    """H.264, one colour range for the whole clip; frames go out as they come."""

    def __init__(self, path: Path, span: ClipRange, size: Size) -> None:
        self._span = span
        self._size = pane_size(size, _MOST_SIDE)
        self._container = av.open(path, "w", format="mp4", options={"movflags": "+faststart"})
        stream = self._container.add_stream("h264", rate=25, options={"crf": "20", "preset": "veryfast"})
        assert isinstance(stream, VideoStream)
        stream.height, stream.width = self._size[0], 2 * self._size[1]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, _TICKS)
        stream.codec_context.thread_count = 1
        self._stream = stream
        self._last = -1

    def add(self, frame: FrameDepth, image: NDArray[np.uint8]) -> None:
        """Encode one pair."""
        pair = np.hstack(
            [_shrink(image, self._size), _shrink(colour_depth(frame.depth, frame.valid, self._span), self._size)]
        )
        video_frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pair), format="rgb24")
        self._last = max(self._last + 1, round(frame.timestamp_s * _TICKS))
        video_frame.pts, video_frame.time_base = self._last, Fraction(1, _TICKS)
        self._container.mux(self._stream.encode(video_frame))

    def close(self) -> None:
        """Finish the file."""
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def abandon(self) -> None:
        """Give up; the file is of no use."""
        self._container.close()


def pane_size(size: Size, most: int) -> Size:
    """Even height and width, no side above ``most``, close to the source's shape."""
    scale = min(1.0, most / max(size))
    h, w = (max(2, 2 * round(side * scale / 2)) for side in size)
    return h, w


def _shrink(image: NDArray[np.uint8], size: Size) -> NDArray[np.uint8]:
    if image.shape[:2] == size:
        return image
    return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA), np.uint8)

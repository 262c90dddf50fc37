"""Decode a video from an open file with PyAV; runs inside the decoding process.

FFmpeg never sees a path or a URL: it gets a file object, no protocol, and only the listed containers and codecs, so a
playlist or a list of file names disguised as a video leads nowhere.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from bathyscope.errors import ClipError
from bathyscope_serve.decode_limits import DecodeLimits
from bathyscope_serve.frames import SURVEY_FRAMES
from bathyscope_serve.regular_file import RegularFile

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
CODECS = frozenset(
    (
        *("h264", "hevc", "vp8", "vp9", "libvpx", "libvpx-vp9", "av1", "libdav1d", "libaom-av1"),
        *("mpeg1video", "mpeg2video", "mpeg4", "msmpeg4v2", "msmpeg4v3", "h263", "wmv1", "wmv2"),
        *("mjpeg", "png", "prores", "dnxhd", "dvvideo", "ffv1", "huffyuv", "ffvhuff", "utvideo", "rawvideo"),
    )
)
_SEQUENTIAL_SURVEY = 128
"""Frames read for the survey where seeking finds too few key frames."""


@dataclass(slots=True)
class Tally:
    """What went wrong while decoding."""

    decoded: int = 0
    corrupt: int = 0
    """Frames or packets flagged as damaged, or that the decoder refused."""
    untimed: int = 0
    """Frames without a usable time stamp."""
    notes: list[str] = field(default_factory=list)
    complete: bool = True

    def stop_early(self, note: str) -> None:
        """Say that what follows is missing."""
        self.complete = False
        self.notes.append(note)

    def summary(self) -> list[str]:
        """Warnings in words."""
        found = list(self.notes)
        if self.corrupt:
            found.append(f"{self.corrupt} damaged frames or packets; depth of frames near them may be wrong")
        if self.untimed:
            found.append(f"{self.untimed} frames had no usable time stamp; theirs were placed one frame interval on")
        return found


@dataclass(frozen=True, slots=True)
class Decoded:
    """One frame as it leaves the decoder."""

    timestamp_s: float
    image: NDArray[np.uint8]


class VideoReader:
    """The first video stream of an open file.

    Raises:
        ClipError: If it is no video of an accepted kind, or asks for more than the limits allow.
    """

    def __init__(self, file: RegularFile, name: str, limits: DecodeLimits) -> None:
        self._file, self._name, self._limits = file, name, limits
        self.tally = Tally()
        if file.length == 0:
            raise ClipError(f"{name}: the file is empty (0 bytes)")
        with self._open() as container:
            stream = self._stream(container)
            self.frame_count: int | None = stream.frames or None
            self._interval_s = float(1 / stream.average_rate) if stream.average_rate else 1 / 25
            self._declared_s = _declared_seconds(container, stream)
            self._counts_packets = container.format.name.startswith("mov")
            # where only the container has a duration, another stream may be what lasts so long
            self._duration_is_ours = stream.duration is not None or len(container.streams) == 1
            self._check_declared(stream)

    def frames(self) -> Iterator[Decoded]:
        """Every frame that decodes, in presentation order.

        Raises:
            ClipError: If a limit is passed on the way.
        """
        previous_s: float | None = None
        size: tuple[int, ...] | None = None
        for frame in self._decode():
            image = upright(frame)
            if size is not None and image.shape != size:
                self.tally.stop_early(
                    f"the frame size changes from {_wxh(size)} to {_wxh(image.shape)} at frame {self.tally.decoded}; "
                    "the rest is left out"
                )
                return
            size = image.shape
            previous_s = self._time(frame, previous_s)
            self.tally.decoded += 1
            self._check_running(image, previous_s)
            yield Decoded(previous_s, image)
        self._check_ending(previous_s)

    def survey(self) -> Iterator[NDArray[np.uint8]]:
        """Frames from all over the video: key frames if there are enough, or else some of the first frames."""
        seen = 0
        for image in self._key_frames():
            seen += 1
            yield image
        if seen >= SURVEY_FRAMES // 4:
            return
        step = _SEQUENTIAL_SURVEY // SURVEY_FRAMES
        decoder = self._decode(tally=False)
        for number, frame in zip(range(_SEQUENTIAL_SURVEY), decoder, strict=False):
            if number % step == 0 or (self.frame_count or step) < SURVEY_FRAMES:
                yield upright(frame)
        decoder.close()

    def _open(self) -> InputContainer:
        self._file.seek(0)
        options = {"protocol_whitelist": "", "format_whitelist": CONTAINERS}
        try:
            container = av.open(self._file, mode="r", options=options)
        except MemoryError as error:
            raise ClipError(f"{self._name}: reading it needs more memory than a decoder gets") from error
        except (av.FFmpegError, ValueError) as error:
            raise ClipError(
                f"{self._name}: not a video that can be read ({_reason(error)}); mp4, mov, mkv, webm and avi are"
            ) from error
        return container

    def _stream(self, container: InputContainer) -> VideoStream:
        pictures = [stream for stream in container.streams.video if not _is_cover(stream)]
        if not pictures:
            kinds = sorted({str(stream.type) for stream in container.streams}) or ["nothing"]
            raise ClipError(
                f"{self._name}: no video stream (container {container.format.name.split(',')[0]}, "
                f"{' and '.join(kinds)} only)"
            )
        stream = pictures[0]
        codec = stream.codec_context.name if stream.codec_context is not None else "unknown"
        if codec not in CODECS:
            raise ClipError(f"{self._name}: codec {codec} is not accepted; convert the video to H.264")
        stream.codec_context.thread_count = 1
        stream.codec_context.options = {"max_pixels": str(2 * self._limits.frame_pixels)}
        return stream

    def _check_declared(self, stream: VideoStream) -> None:
        limits = self._limits
        check_size(self._name, (stream.height, stream.width), limits)
        if stream.frames > limits.frames:
            raise ClipError(f"{self._name}: {stream.frames} frames; at most {limits.frames} are read, cut it up")
        if self._declared_s is not None and self._declared_s > limits.duration_s:
            raise ClipError(f"{self._name}: {self._declared_s:.0f} s long; at most {limits.duration_s:.0f} s are read")
        self._check_pixels(stream.frames * stream.height * stream.width)

    def _check_pixels(self, pixels: int) -> None:
        budget = self._limits.pixel_budget(self._file.length)
        if pixels > budget:
            raise ClipError(
                f"{self._name}: {self._file.length} bytes decode to {pixels} pixels and more; a file of this size may "
                f"hold {budget}"
            )

    def _check_running(self, image: NDArray[np.uint8], timestamp_s: float) -> None:
        if self.tally.decoded > self._limits.frames:
            raise ClipError(f"{self._name}: more than {self._limits.frames} frames; cut it into parts")
        if timestamp_s > self._limits.duration_s:
            raise ClipError(f"{self._name}: longer than {self._limits.duration_s:.0f} s; cut it into parts")
        self._check_pixels(self.tally.decoded * image.shape[0] * image.shape[1])

    def _check_ending(self, last_s: float | None) -> None:
        """A file cut short is told by its packets, or, where the container does not count them, by its duration."""
        if last_s is None or self._declared_s is None or not self._duration_is_ours:
            return
        if last_s + 2 * self._interval_s < 0.98 * self._declared_s - 0.25:
            self.tally.stop_early(f"the video ends at {last_s:.2f} s of the {self._declared_s:.2f} s it declares")

    def _time(self, frame: VideoFrame, previous_s: float | None) -> float:
        """Time stamp of a frame; one interval after the previous where it has none or would go back."""
        time_s = frame.time
        if time_s is not None and np.isfinite(time_s) and (previous_s is None or time_s >= previous_s):
            return float(time_s)
        self.tally.untimed += 1
        return 0.0 if previous_s is None else previous_s + self._interval_s

    def _decode(self, tally: bool = True) -> Generator[VideoFrame]:
        """Frames of the stream; damaged packets are counted and skipped."""
        count = self.tally if tally else Tally()
        with self._open() as container:
            stream = self._stream(container)
            packets = 0
            try:
                for packet in container.demux(stream):
                    packets += packet.size > 0
                    count.corrupt += bool(packet.is_corrupt)
                    yield from self._frames_of(packet, count)
            except av.FFmpegError as error:
                count.stop_early(f"reading stopped after {count.decoded} frames: {_reason(error)}")
            if self._counts_packets and stream.frames > packets:
                count.stop_early(f"the file declares {stream.frames} frames and holds {packets}; it was cut short")

    def _frames_of(self, packet: Any, count: Tally) -> Iterator[VideoFrame]:
        try:
            frames = packet.decode()
        except MemoryError as error:
            raise ClipError(f"{self._name}: decoding it needs more memory than a decoder gets") from error
        except av.FFmpegError:
            count.corrupt += 1
            return
        for frame in frames:
            check_size(self._name, (frame.height, frame.width), self._limits)
            count.corrupt += bool(frame.is_corrupt)
            yield frame

    def _key_frames(self) -> Iterator[NDArray[np.uint8]]:
        """Different key frames at even distances; nothing where the file cannot be searched."""
        if self._declared_s is None:
            return
        found: set[int] = set()
        with self._open() as container, suppress(av.FFmpegError):
            stream = self._stream(container)
            for part in range(SURVEY_FRAMES):
                container.seek(int(self._declared_s * part / SURVEY_FRAMES * 1_000_000))
                frame = next(container.decode(stream), None)
                if frame is not None and frame.pts is not None and frame.pts not in found:
                    check_size(self._name, (frame.height, frame.width), self._limits)
                    found.add(frame.pts)
                    yield upright(frame)


def upright(frame: VideoFrame) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3) of a frame, turned as its rotation metadata says."""
    # one thread: the decoding process may not start any
    image = np.asarray(frame.to_ndarray(format="rgb24", threads=1), np.uint8)
    return np.rot90(image, round(frame.rotation / 90) % 4) if frame.rotation else image


def check_size(name: str, size: tuple[int, int], limits: DecodeLimits) -> None:
    """Refuse frames that are too large or too small.

    Raises:
        ClipError: If they are.
    """
    h, w = size
    if max(h, w) > limits.side_pixels or h * w > limits.frame_pixels:
        raise ClipError(
            f"{name}: frames of {w}x{h}; at most {limits.frame_pixels} pixels and {limits.side_pixels} a side are "
            "read, scale the video down"
        )
    if min(h, w) < limits.least_side_pixels:
        raise ClipError(f"{name}: frames of {w}x{h}; both sides need at least {limits.least_side_pixels} pixels")


def _declared_seconds(container: InputContainer, stream: VideoStream) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return container.duration / 1_000_000 if container.duration is not None else None


def _is_cover(stream: VideoStream) -> bool:
    """Whether a 'video' stream is the cover picture of a music file."""
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def _wxh(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"

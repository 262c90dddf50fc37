"""The user's own frames, for pictures beside the depth; the file is decoded a second time, frame by frame."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

from bathyscope.errors import ClipError
from bathyscope.result import FrameDepth
from bathyscope_client.clips import IMAGE_RATE, IMAGE_SUFFIXES, images_in, natural_key

Image = NDArray[np.uint8]
_SAME_TIME_S = 5e-4


@dataclass(frozen=True, slots=True)
class SourceFrame:
    """A frame of the source."""

    timestamp_s: float
    image: Image
    """(h, w, 3) RGB, upright."""


def pair_with_source(frames: Iterable[FrameDepth], path: Path) -> Iterator[tuple[FrameDepth, Image]]:
    """Each frame of a result with the source frame it was made from, found by its time stamp.

    Raises:
        ClipError: If a frame has no partner, because the source is not the one the result was made from.
    """
    with closing(source_frames(path)) as sources:
        for frame in frames:
            found = next((source for source in sources if source.timestamp_s > frame.timestamp_s - _SAME_TIME_S), None)
            if found is None or found.timestamp_s > frame.timestamp_s + _SAME_TIME_S:
                raise ClipError(f"{path.name}: it has no frame at {frame.timestamp_s:.4f} s, where the result has one")
            if found.image.shape[:2] != frame.depth.shape:
                raise ClipError(f"{path.name}: frames of {found.image.shape[:2]}, the result has {frame.depth.shape}")
            yield frame, found.image


def source_frames(path: Path) -> Generator[SourceFrame]:
    """The frames of a video, a zip of images, or a folder of images."""
    if path.is_dir():
        return _images(image.read_bytes() for image in images_in(path))
    with path.open("rb") as file:
        is_zip = file.read(2) == b"PK"
    return _zipped(path) if is_zip else _video(path)


def _video(path: Path) -> Generator[SourceFrame]:
    previous_s: float | None = None
    with path.open("rb") as file, _opened(file, path) as container:
        stream = next(s for s in container.streams.video if not s.disposition & av.stream.Disposition.attached_pic)
        interval_s = float(1 / stream.average_rate) if stream.average_rate else 1 / IMAGE_RATE
        for frame in _decoded(container, stream):
            previous_s = _time(frame.time, previous_s, interval_s)
            image = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
            yield SourceFrame(previous_s, np.rot90(image, round(frame.rotation / 90) % 4))


def _opened(file: BinaryIO, path: Path) -> InputContainer:
    try:
        return av.open(file, mode="r", options={"protocol_whitelist": ""})
    except (av.FFmpegError, ValueError) as error:
        raise ClipError(f"{path.name}: cannot be decoded for the pictures ({error})") from error


def _decoded(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Every frame that decodes; damaged packets are skipped and a damaged end ends it, as in the engine."""
    with suppress(av.FFmpegError):
        for packet in container.demux(stream):
            with suppress(av.FFmpegError):
                yield from packet.decode()


def _time(time_s: float | None, previous_s: float | None, interval_s: float) -> float:
    """The engine's rule: one interval on where a time stamp is missing or goes back."""
    if time_s is not None and (previous_s is None or time_s >= previous_s):
        return time_s
    return 0.0 if previous_s is None else previous_s + interval_s


def _zipped(path: Path) -> Generator[SourceFrame]:
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if _is_image(PurePosixPath(name))]
        yield from _images(_member(archive, name) for name in sorted(names, key=natural_key))


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """A picture's bytes; nothing where the zip is damaged, as in the engine."""
    try:
        return archive.read(name)
    except (zipfile.BadZipFile, EOFError, zlib.error):
        return b""


def _is_image(path: PurePosixPath) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _images(files: Iterable[bytes]) -> Generator[SourceFrame]:
    for number, data in enumerate(files):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if image is not None:
            yield SourceFrame(number / IMAGE_RATE, np.ascontiguousarray(image[..., ::-1]))

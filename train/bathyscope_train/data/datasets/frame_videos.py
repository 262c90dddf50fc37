"""Frames of a video file, in any order, decoded with PyAV in this process: for videos of one's own.

FFmpeg gets an open file, no path and no protocol, so a playlist that calls itself a video leads nowhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.sequence import Image

VIDEO_ENDINGS = frozenset((".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".mpg", ".mpeg"))
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegvideo"


@dataclass(frozen=True, slots=True)
class _Table:
    """What demuxing alone tells of a video."""

    times: tuple[int, ...]
    """Presentation time of each frame, in units of the stream; its number where the file has no usable times."""
    size: Size
    untimed: bool
    """Frames can only be counted from the first: AVI, and files without time stamps."""


@dataclass(eq=False)
class VideoFrames:
    """The frames of a video. Reading in order decodes each once; a jump begins at the key frame before it.

    Where times cannot be trusted (AVI), frames are counted, and a jump back begins at the first frame.

    Args:
        path: The file.
        upper_half: Take the upper half of each picture: the left eye of a video that stacks both.
    """

    path: Path
    upper_half: bool = False
    _decoder: Iterator[Any] | None = field(default=None, init=False, repr=False)
    _next: int = field(default=0, init=False, repr=False)

    def __len__(self) -> int:
        return len(self._table.times)

    @property
    def size(self) -> Size:
        """(height, width) of a frame."""
        height, width = self._table.size
        return (height // 2 if self.upper_half else height), width

    def where(self, index: int) -> str:
        """The file and the number of the frame."""
        return f"{self.path}, frame {index}"

    def read(self, index: int) -> Image:
        """A frame.

        Raises:
            DatasetError: If it cannot be decoded.
        """
        if not 0 <= index < len(self):
            raise DatasetError(f"{self.path}: frame {index} of {len(self)}")
        frame = self._counted(index) if self._table.untimed else self._timed(index)
        if frame is None:
            self._decoder = None
            raise DatasetError(f"{self.where(index)}: it cannot be decoded; the file is damaged there")
        self._next = index + 1
        image: Image = frame.to_ndarray(format="rgb24")
        return image[: image.shape[0] // 2] if self.upper_half else image

    def _timed(self, index: int) -> Any:
        """The frame of this number by its time; ``None`` if it does not come."""
        wanted = self._table.times[index]
        if self._decoder is None or not 0 <= index - self._next <= _LONGEST_WALK:
            self._decoder = self._decode_from(wanted)
        for frame in self._decoder:
            if frame.pts is not None and frame.pts >= wanted:
                return frame if frame.pts == wanted else None
        return None

    def _counted(self, index: int) -> Any:
        """The frame of this number, counted from the first; ``None`` if there are not so many."""
        if self._decoder is None or index < self._next:
            self._decoder, self._next = self._decode_from(None), 0
        for frame in self._decoder:
            self._next += 1
            if self._next == index + 1:
                return frame
        return None

    @cached_property
    def _table(self) -> _Table:
        import av

        with self.path.open("rb") as file, _opened(self.path, file) as container:
            stream = _pictures(self.path, container)
            try:
                times = [packet.pts for packet in container.demux(stream) if packet.size and not packet.is_discard]
            except av.FFmpegError as error:
                raise DatasetError(f"{self.path}: the video is damaged ({_reason(error)})") from error
            size = stream.height, stream.width
        if not times or 0 in size:
            raise DatasetError(f"{self.path}: the video holds no frames")
        untimed = container.format.name == "avi" or None in times or len(set(times)) < len(times)
        return _Table(tuple(range(len(times)) if untimed else sorted(times)), size, untimed)

    def _decode_from(self, time: int | None) -> Iterator[Any]:
        """Frames from the key frame before ``time`` on, or all of them; damaged ones are passed over."""
        import av

        with self.path.open("rb") as file, _opened(self.path, file) as container:
            stream = _pictures(self.path, container)
            stream.codec_context.thread_count = 1
            if time is not None and time > self._table.times[0]:
                container.seek(time, stream=stream, backward=True)
            for packet in container.demux(stream):
                try:
                    decoded = packet.decode()
                except av.FFmpegError:
                    continue
                yield from decoded

    def files(self) -> tuple[Path, ...]:
        """The video."""
        return (self.path,)

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "upper_half": self.upper_half}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _decoder=None, _next=0)


_LONGEST_WALK = 64
"""Frames that are decoded and thrown away rather than looking for a key frame."""


def is_video(path: Path) -> bool:
    """Whether a file calls itself a video."""
    return path.suffix.lower() in VIDEO_ENDINGS and path.is_file() and not path.name.startswith(".")


def _opened(path: Path, file: Any) -> Any:
    import av

    try:
        return av.open(file, mode="r", options={"protocol_whitelist": "", "format_whitelist": _CONTAINERS})
    except (av.FFmpegError, ValueError) as error:
        raise DatasetError(f"{path}: not a video that can be read ({_reason(error)})") from error


def _pictures(path: Path, container: Any) -> Any:
    if not container.streams.video:
        kinds = " and ".join(sorted({str(stream.type) for stream in container.streams})) or "nothing"
        raise DatasetError(f"{path}: no video stream ({kinds} only)")
    return container.streams.video[0]


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)

"""Decode a folder or a zip of PNG and JPEG images as one clip; runs inside the decoding process.

Files are told by their first bytes, not their names, and decoded by FFmpeg's picture codecs alone: no demuxer that
could read a list or a pattern is involved.
"""

from __future__ import annotations

import re
import stat
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import cast

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray

from bathyscope.errors import ClipError
from bathyscope_serve.decode_limits import DecodeLimits
from bathyscope_serve.frames import SURVEY_FRAMES
from bathyscope_serve.regular_file import RegularFile
from bathyscope_serve.video import Decoded, Tally, check_size, upright

IMAGE_RATE = 25.0
"""Frames a second of images, which have no time stamps of their own."""
MAX_IMAGE_BYTES = 256 << 20
MAX_MEMBERS = 250_000
_CODECS = {b"\x89PNG\r\n\x1a\n": "png", b"\xff\xd8\xff": "mjpeg"}
_SUFFIXES = frozenset((".png", ".jpg", ".jpeg"))


class ImageReader:
    """Images of one size, in the natural order of their names (2 before 10).

    Args:
        names: Names of the images.
        read: Gives the bytes of one.
        total_bytes: Size of all of them as stored.
        name: What messages call the clip.
        limits: What may be asked for.

    Raises:
        ClipError: If there is no image, or too many.
    """

    def __init__(
        self, names: list[str], read: Callable[[str], bytes], total_bytes: int, name: str, limits: DecodeLimits
    ) -> None:
        self._names = sorted(names, key=natural_key)
        self._read, self._bytes, self._name, self._limits = read, total_bytes, name, limits
        self.tally = Tally()
        if not self._names:
            raise ClipError(f"{name}: no PNG or JPEG image in it")
        if len(self._names) > limits.frames:
            raise ClipError(f"{name}: {len(self._names)} images; at most {limits.frames} are read")
        self.frame_count: int | None = len(self._names)
        self.tally.notes.append(f"images have no time stamps: {IMAGE_RATE:g} a second are assumed")

    def frames(self) -> Iterator[Decoded]:
        """Every image that decodes.

        Raises:
            ClipError: If sizes differ, or a limit is passed.
        """
        first: tuple[str, tuple[int, ...]] | None = None
        for number, name in enumerate(self._names):
            image = self._decode(name)
            if image is None:
                self.tally.complete = False
                self.tally.corrupt += 1
                continue
            first = first or (name, image.shape)
            if image.shape != first[1]:
                (a, (h, w, _)), (y, x, _) = first, image.shape
                raise ClipError(
                    f"{self._name}: {a} is {w}x{h}, {name} is {x}x{y}; the images of a clip must have one size"
                )
            self.tally.decoded += 1
            if self.tally.decoded * image.shape[0] * image.shape[1] > self._limits.pixel_budget(self._bytes):
                raise ClipError(f"{self._name}: {self._bytes} bytes decode to too many pixels; cut it up")
            yield Decoded(number / IMAGE_RATE, image)

    def survey(self) -> Iterator[NDArray[np.uint8]]:
        """Images from all over the clip."""
        for number in sorted(set(np.linspace(0, len(self._names) - 1, SURVEY_FRAMES).astype(int).tolist())):
            image = self._decode(self._names[number])
            if image is not None:
                yield image

    def _decode(self, name: str) -> NDArray[np.uint8] | None:
        """RGB pixels of one image, or ``None`` if it is damaged."""
        data = self._read(name)
        codec = next((codec for magic, codec in _CODECS.items() if data.startswith(magic)), None)
        if codec is None:
            return None
        size = declared_size(data)
        if size is not None:
            check_size(f"{self._name}: {name}", size, self._limits)
        context = cast(VideoCodecContext, VideoCodecContext.create(codec, "r"))
        context.thread_count = 1
        context.options = {"max_pixels": str(2 * self._limits.frame_pixels)}
        try:
            frames = [*context.decode(av.Packet(data)), *context.decode(None)]
        except MemoryError as error:
            raise ClipError(f"{self._name}: {name} needs more memory than a decoder gets") from error
        except av.FFmpegError:
            return None
        if not frames:
            return None
        check_size(f"{self._name}: {name}", (frames[0].height, frames[0].width), self._limits)
        self.tally.corrupt += bool(frames[0].is_corrupt)
        return upright(frames[0])


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers: ``f2`` before ``f10``."""
    parts = re.split(r"(\d{1,18})", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def declared_size(data: bytes) -> tuple[int, int] | None:
    """(height, width) from the header of a PNG or JPEG; ``None`` if it has none that can be read."""
    if data.startswith(b"\x89PNG"):
        return (int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")) if len(data) >= 24 else None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            return int.from_bytes(data[place + 5 : place + 7], "big"), int.from_bytes(
                data[place + 7 : place + 9], "big"
            )
        place += 2 + length
    return None


def open_folder(folder: Path, name: str, limits: DecodeLimits) -> ImageReader:
    """The images that lie directly in a folder; other files are left alone.

    Raises:
        ClipError: If there is none.
    """
    paths = [path for path in folder.iterdir() if _is_image_name(path.name) and path.is_file()]

    def read(entry: str) -> bytes:
        path = folder / entry
        if path.stat().st_size > MAX_IMAGE_BYTES:
            raise ClipError(f"{name}: {entry} has {path.stat().st_size} bytes; at most {MAX_IMAGE_BYTES} are read")
        return path.read_bytes()

    return ImageReader([path.name for path in paths], read, sum(path.stat().st_size for path in paths), name, limits)


def open_zip(file: RegularFile, name: str, limits: DecodeLimits) -> ImageReader:
    """The images in a zip; nothing is unpacked to disk.

    Raises:
        ClipError: If it is damaged, encrypted, holds names that leave it, or unpacks to far more than it is.
    """
    file.seek(0)
    try:
        archive = zipfile.ZipFile(file)
        members = {member.filename: member for member in archive.infolist()}
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise ClipError(f"{name}: a zip that cannot be read ({error})") from error
    if len(members) > MAX_MEMBERS:
        raise ClipError(f"{name}: a zip of {len(members)} members; at most {MAX_MEMBERS} are read")
    for member in members.values():
        _check_member(member, name)
    images = [entry for entry, member in members.items() if _is_image_name(PurePosixPath(entry).name)]
    folders = {str(PurePosixPath(entry).parent) for entry in images}
    if len(folders) > 1:
        raise ClipError(f"{name}: the images lie in {len(folders)} folders; a zip is one clip, send one zip a folder")

    def read(entry: str) -> bytes:
        try:
            with archive.open(members[entry]) as source:
                data = source.read(MAX_IMAGE_BYTES + 1)
        except (zipfile.BadZipFile, OSError, EOFError, RuntimeError, NotImplementedError, ValueError):
            return b""
        if len(data) > MAX_IMAGE_BYTES:
            raise ClipError(f"{name}: {entry} unpacks to more than {MAX_IMAGE_BYTES} bytes")
        return data

    return ImageReader(images, read, file.length, name, limits)


def _check_member(member: zipfile.ZipInfo, name: str) -> None:
    path = PurePosixPath(member.filename.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0:1]:
        raise ClipError(f"{name}: member {member.filename!r} leaves the zip")
    if member.flag_bits & 1:
        raise ClipError(f"{name}: member {member.filename!r} is encrypted")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise ClipError(f"{name}: member {member.filename!r} is a link")
    if member.file_size > MAX_IMAGE_BYTES:
        raise ClipError(f"{name}: member {member.filename!r} unpacks to {member.file_size} bytes")


def _is_image_name(name: str) -> bool:
    return not name.startswith(".") and PurePosixPath(name).suffix.lower() in _SUFFIXES

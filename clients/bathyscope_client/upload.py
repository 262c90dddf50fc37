"""A clip's way to the service: a file, an open file, or a folder of images packed on the way."""

from __future__ import annotations

import mimetypes
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from bathyscope.errors import ClipError
from bathyscope_client.clips import images_in

BLOCK_BYTES = 1 << 18
OnBytes = Callable[[int, int | None], None]
"""Called with the bytes done so far and the bytes in all, if known."""


def ignore_bytes(done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True, slots=True)
class Upload:
    """An open clip, its type, name and length."""

    file: BinaryIO
    name: str
    content_type: str
    length: int | None
    start: int

    @property
    def repeatable(self) -> bool:
        """Whether it can be sent again."""
        return self.length is not None

    def blocks(self, on_bytes: OnBytes) -> Iterator[bytes]:
        """The content, from where the file stood."""
        if self.repeatable:
            self.file.seek(self.start)
        done = 0
        while block := self.file.read(BLOCK_BYTES):
            yield block
            done += len(block)
            on_bytes(done, self.length)


@contextmanager
def open_upload(source: Path | str | BinaryIO) -> Iterator[Upload]:
    """Open what is to be sent.

    Raises:
        ClipError: If there is no such file, or a folder holds no images.
    """
    if not isinstance(source, Path | str):
        yield _describe(source, Path(str(getattr(source, "name", "clip"))))
        return
    path = Path(source)
    if path.is_dir():
        with tempfile.TemporaryFile() as packed:
            pack_images(path, packed)
            packed.seek(0)
            yield _describe(packed, path.with_suffix(path.suffix + ".zip"))
        return
    try:
        with path.open("rb") as file:
            yield _describe(file, path)
    except (FileNotFoundError, PermissionError) as error:
        raise ClipError(
            f"{path}: cannot be read ({error.strerror}); give a video, a zip or a folder of images"
        ) from error


def pack_images(folder: Path, target: BinaryIO) -> None:
    """A zip, without further compression, of the images that lie in a folder.

    Raises:
        ClipError: If there is none.
    """
    images = images_in(folder)
    if not images:
        raise ClipError(f"{folder}: no PNG or JPEG image in it")
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        for image in images:
            archive.write(image, image.name)


def _describe(file: BinaryIO, path: Path) -> Upload:
    start, length = 0, None
    if file.seekable():
        start = file.tell()
        length = file.seek(0, 2) - start
        file.seek(start)
    return Upload(file, path.name, _content_type(path), length, start)


def _content_type(path: Path) -> str:
    guessed = mimetypes.guess_type(path.name)[0] or ""
    if guessed.startswith("video/") or guessed == "application/zip":
        return guessed
    return "application/octet-stream"

"""Frames that lie in image files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.sequence import Image
from bathyscope_train.evaluation.images import read_colour


@dataclass(frozen=True)
class ImageFiles:
    """One image a frame; of a picture that stacks two eyes only the upper half where ``upper_half`` is set."""

    paths: tuple[Path, ...]
    upper_half: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, index: int) -> Image:
        """A frame; refuses files that are cut short, which OpenCV would fill with grey."""
        path = self.paths[index]
        if not path.is_file():
            raise DatasetError(f"{path}: the frame is missing")
        _check_whole(path)
        image = read_colour(path)
        return image[: image.shape[0] // 2] if self.upper_half else image

    def where(self, index: int) -> str:
        """Path of the file."""
        return str(self.paths[index])

    def files(self) -> tuple[Path, ...]:
        """All of them."""
        return self.paths


def number_in(path: Path) -> int:
    """The last number in a file name without its ending: 12 for ``frame_data000012.png``, 7 for ``7.jpg``.

    Raises:
        DatasetError: If there is none.
    """
    numbers = re.findall(r"\d+", path.stem)
    if not numbers:
        raise DatasetError(f"{path}: no number in the name; frames are told by their numbers")
    return int(numbers[-1])


def by_number(paths: Sequence[Path]) -> dict[int, Path]:
    """Files by the number in their names, in its order.

    Raises:
        DatasetError: If two files have one number, or one has none.
    """
    found: dict[int, Path] = {}
    for path in paths:
        number = number_in(path)
        if number in found:
            raise DatasetError(f"{path.parent}: {found[number].name} and {path.name} have the same number")
        found[number] = path
    return dict(sorted(found.items()))


def image_size(path: Path) -> Size:
    """(height, width) from the header of an image file.

    Raises:
        DatasetError: If it is no image.
    """
    from PIL import Image as Pictures

    try:
        with Pictures.open(path) as picture:
            width, height = picture.size
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable image ({error})") from error
    return height, width


def _check_whole(path: Path) -> None:
    """Refuse a JPEG or PNG without its end mark."""
    data = path.read_bytes()
    marks = {b"\xff\xd8\xff": b"\xff\xd9", b"\x89PNG": b"IEND"}
    end = next((mark for start, mark in marks.items() if data.startswith(start)), None)
    if end is not None and data.rfind(end) < len(data) // 2:
        raise DatasetError(f"{path}: the image is cut short ({len(data)} bytes, no end mark)")

"""Images of data set folders, through OpenCV."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import DatasetError

_SUFFIXES = (".jpg", ".jpeg", ".png")


def image_files(folder: Path) -> tuple[Path, ...]:
    """Images in a folder in video order: numbers in names count as numbers, so 10 follows 9."""
    if not folder.is_dir():
        return ()
    files = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")]
    return tuple(sorted(files, key=_natural_key))


def read_values(path: Path) -> Any:
    """Pixels as stored: (h, w) grey or (h, w, c), of the type in the file.

    Raises:
        DatasetError: If the file is no image that OpenCV reads.
    """
    import cv2

    return _decode(path, cv2.IMREAD_UNCHANGED)


def read_colour(path: Path) -> NDArray[np.uint8]:
    """RGB (h, w, 3), whatever the file holds: grey, 16 bits and transparency are converted, as decoders do.

    Raises:
        DatasetError: If the file is no image that OpenCV reads.
    """
    import cv2

    return np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR)[..., ::-1], np.uint8)


def _decode(path: Path, flags: int) -> Any:
    import cv2

    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), flags)
    if image is None:
        raise DatasetError(f"{path}: not a readable image ({path.stat().st_size} bytes)")
    return image


def _natural_key(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

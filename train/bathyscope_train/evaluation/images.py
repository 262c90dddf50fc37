"""Images of data set folders, through OpenCV."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from bathyscope.errors import DatasetError

_SUFFIXES = (".jpg", ".jpeg", ".png")


def image_files(folder: Path) -> tuple[Path, ...]:
    """Images in a folder in video order: numbers in names count as numbers, so 10 follows 9."""
    if not folder.is_dir():
        return ()
    files = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")]
    return tuple(sorted(files, key=_natural_key))


def read_image(path: Path) -> Any:
    """Pixels as stored: (h, w) grey or (h, w, c) with channels in OpenCV's order, BGR.

    Raises:
        DatasetError: If the file is no image that OpenCV reads.
    """
    import cv2

    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"{path}: not a readable image ({path.stat().st_size} bytes)")
    return image


def _natural_key(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

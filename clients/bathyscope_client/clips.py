"""Which clips a path stands for: a video, a zip of images, a folder of images, or a folder of videos."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bathyscope.errors import ClipError

VIDEO_SUFFIXES = frozenset((".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi"))
IMAGE_SUFFIXES = frozenset((".png", ".jpg", ".jpeg"))
IMAGE_RATE = 25.0
"""Images a second, where a clip is made of images; the engine assumes the same."""


@dataclass(frozen=True, slots=True)
class LocalClip:
    """A clip of the user and the name that its output files carry."""

    name: str
    path: Path


def find_clips(path: Path) -> list[LocalClip]:
    """The clips at a path, in natural order.

    Videos in a folder that share a stem keep their suffix in the name.

    Raises:
        ClipError: If there is nothing, or a folder holds neither videos nor images.
    """
    if path.is_file():
        return [LocalClip(path.stem, path)]
    if not path.is_dir():
        raise ClipError(f"{path}: no such file or folder")
    videos = _files(path, VIDEO_SUFFIXES)
    if not videos:
        if not images_in(path):
            raise ClipError(
                f"{path}: neither videos ({_listed(VIDEO_SUFFIXES)}) nor images ({_listed(IMAGE_SUFFIXES)})"
            )
        return [LocalClip(path.resolve().name or "clip", path)]
    stems = Counter(video.stem for video in videos)
    return [LocalClip(video.stem if stems[video.stem] == 1 else video.name, video) for video in videos]


def images_in(folder: Path) -> list[Path]:
    """The images that lie directly in a folder, in natural order (2 before 10)."""
    return _files(folder, IMAGE_SUFFIXES)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"(\d{1,18})", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    found = (
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    )
    return sorted(found, key=lambda path: natural_key(path.name))


def _listed(suffixes: frozenset[str]) -> str:
    return ", ".join(sorted(suffixes))

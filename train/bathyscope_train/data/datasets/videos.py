"""Any folder of videos or frames, without ground truth: what most people have.

A video file is a sequence, and so is a folder that holds images; folders are looked into as deep as they go.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.frame_files import ImageFiles, image_size
from bathyscope_train.data.datasets.frame_videos import VideoFrames, is_video
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.images import image_files
from bathyscope_train.evaluation.sequences import Gap

SHORTEST = 2
"""Frames of a clip that can show motion."""
_NOT_FRAMES = frozenset(("depth", "masks", "mask", "normals", "flow", "depth01", "depth02"))
"""Folders whose images are no frames."""


@dataclass(frozen=True)
class FoundVideos:
    """What can be used of a folder, and what cannot."""

    sequences: tuple[DataSequence, ...]
    gaps: tuple[Gap, ...]


def open_videos(root: Path, *, upper_half: bool = False) -> FoundVideos:
    """The videos and folders of images below ``root``, or the one that ``root`` is.

    Args:
        root: A folder, or a video file.
        upper_half: The pictures stack two eyes; take the upper one.

    Raises:
        DatasetError: If nothing can be used; says why for each.
    """
    if not root.exists():
        raise DatasetError(f"{root}: no such file or folder")
    sequences: list[DataSequence] = []
    gaps: list[Gap] = []
    for path in _candidates(root):
        name = path.resolve().name if path == root else path.relative_to(root).as_posix()
        try:
            sequences.append(_open(path, name, upper_half))
        except DatasetError as error:
            gaps.append(Gap(name, "", str(error)))
    if not sequences:
        reasons = "; ".join(gap.reason for gap in gaps[:5]) or "no video files (.mp4, .mov, .mkv ...) and no images"
        raise DatasetError(f"{root}: nothing to train on: {reasons}")
    return FoundVideos(tuple(sequences), tuple(gaps))


def _candidates(root: Path) -> list[Path]:
    if root.is_file():
        return [root]
    found: list[Path] = []
    for folder, names, _ in os.walk(root):
        names[:] = sorted(name for name in names if not name.startswith(".") and name.lower() not in _NOT_FRAMES)
        place = Path(folder)
        found += [place] if image_files(place) else []
        found += sorted(path for path in place.iterdir() if is_video(path))
    return found


def _open(path: Path, name: str, upper_half: bool) -> DataSequence:
    if path.is_file():
        video = VideoFrames(path, upper_half)
        _check_length(path, len(video))
        numbers = [f"{index:06d}" for index in range(len(video))]
        return DataSequence(name=name, frames=video, frame_names=numbers, size=video.size)
    files = image_files(path)
    _check_length(path, len(files))
    height, width = _first_size(files)
    return DataSequence(
        name=name,
        frames=ImageFiles(files, upper_half),
        frame_names=[file.name for file in files],
        size=(height // 2 if upper_half else height, width),
    )


def _first_size(files: tuple[Path, ...]) -> tuple[int, int]:
    """Size of the first image that can be read."""
    problem: DatasetError | None = None
    for file in files:
        try:
            return image_size(file)
        except DatasetError as error:
            problem = problem or error
    assert problem is not None
    raise problem


def _check_length(path: Path, frames: int) -> None:
    if frames < SHORTEST:
        raise DatasetError(f"{path}: {frames} frame; a clip to train on needs at least {SHORTEST}")

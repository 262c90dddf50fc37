"""Folders of rendered clips as videos to train on: their true depth and poses are left aside."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.sequence import DataSequence, Image
from bathyscope_train.data.synthetic.shards import clip_paths, read_clip


@dataclass(frozen=True)
class RenderedFrames:
    """The frames of one rendered clip; a :class:`~bathyscope_train.data.datasets.sequence.FrameReader`."""

    path: Path
    frames: int

    def __len__(self) -> int:
        return self.frames

    def read(self, index: int) -> Image:
        """A frame (h, w, 3)."""
        frame: Image = _frames(self.path)[index]
        return frame

    def where(self, index: int) -> str:
        """File and number of a frame."""
        return f"{self.path} frame {index}"

    def files(self) -> tuple[Path, ...]:
        """The clip's file."""
        return (self.path,)


@lru_cache(maxsize=256)
def _frames(path: Path) -> NDArray[np.uint8]:
    return read_clip(path).frames


def is_rendered(folder: Path) -> bool:
    """Whether a folder holds rendered clips."""
    return folder.is_dir() and next(folder.glob("[0-9]*.npz"), None) is not None


def rendered_videos(folder: Path) -> tuple[list[DataSequence], list[str]]:
    """The clips of a folder as videos, and what cannot be read of them.

    Raises:
        DatasetError: If not one clip can be read.
    """
    found: list[DataSequence] = []
    notes: list[str] = []
    for path in clip_paths(folder):
        try:
            clip = read_clip(path)
        except DatasetError as error:
            notes.append(f"{error}; left out")
            continue
        count, height, width = clip.frames.shape[:3]
        found.append(
            DataSequence(
                name=clip.name,
                frames=RenderedFrames(path, count),
                frame_names=[f"{index:06d}" for index in range(count)],
                size=(height, width),
                intrinsics=clip.intrinsics,
            )
        )
    if not found:
        raise DatasetError(f"{folder}: not one rendered clip can be read: {'; '.join(notes[:5])}")
    return found, notes

"""All files of one clip, made from its result and its source in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bathyscope.result import FrameDepth, ResultMeta
from bathyscope.result_files import NpzReader
from bathyscope.result_zip import write_zip
from bathyscope_client.camera_files import write_camera_files
from bathyscope_client.contact_sheet import SheetWriter
from bathyscope_client.depth_colours import measure_range
from bathyscope_client.point_cloud import CloudWriter
from bathyscope_client.preview import PreviewWriter
from bathyscope_client.source_frames import pair_with_source

SUFFIXES = {
    "depth": ".npz",
    "pictures": ".zip",
    "preview": "_preview.mp4",
    "poses": "_poses.txt",
    "intrinsics": "_intrinsics.json",
    "cloud": "_cloud.ply",
    "sheet": "_sheet.png",
}
"""What each file's name is the clip's name and."""
_OF_CAMERAS = ("poses", "intrinsics", "cloud")
"""Files that a network without cameras cannot give."""
OnFrames = Callable[[int, int], None]


class FrameWriter(Protocol):
    """A file that is made frame by frame."""

    def add(self, frame: FrameDepth, image: NDArray[np.uint8]) -> None:
        """Take one frame of the result and the source frame it belongs to."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...

    def abandon(self) -> None:
        """Give up, freeing what is held."""
        ...


def output_paths(folder: Path, name: str) -> dict[str, Path]:
    """Where the files of a clip lie."""
    return {kind: folder / f"{name}{suffix}" for kind, suffix in SUFFIXES.items()}


def made_of(meta: ResultMeta) -> tuple[str, ...]:
    """Which of the files a result with this meta data gives."""
    return tuple(kind for kind in SUFFIXES if kind not in _OF_CAMERAS or "cameras" in meta.outputs)


def write_outputs(source: Path, paths: dict[str, Path], most_points: int, on_frames: OnFrames) -> ResultMeta:
    """Make every other file of a clip from ``paths["depth"]``, as far as :func:`made_of` its meta data goes.

    Raises:
        ResultError: If the result is damaged.
        ClipError: If the source does not belong to it.
    """
    write_zip(paths["depth"], paths["pictures"])
    with NpzReader(paths["depth"]) as reader:
        made = made_of(reader.meta)
        if "poses" in made:
            write_camera_files(reader, paths["poses"], paths["intrinsics"])
        span = measure_range(reader, disparity="disparity" in reader.meta.outputs)
        scale = reader.meta.scale
        writers_of: list[FrameWriter] = [
            PreviewWriter(paths["preview"], span, reader.size),
            SheetWriter(paths["sheet"], span, reader.size, scale),
        ]
        if "cloud" in made:
            writers_of.append(CloudWriter(paths["cloud"], span, most_points, scale))
        with _finished(*writers_of) as writers:
            for number, (frame, image) in enumerate(pair_with_source(reader, source), 1):
                for writer in writers:
                    writer.add(frame, image)
                on_frames(number, len(reader))
        return reader.meta


@contextmanager
def _finished(*writers: FrameWriter) -> Iterator[tuple[FrameWriter, ...]]:
    try:
        yield writers
        for writer in writers:
            writer.close()
    except BaseException:
        for writer in writers:
            writer.abandon()
        raise

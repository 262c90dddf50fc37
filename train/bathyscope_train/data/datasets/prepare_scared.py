"""Convert SCARED's official archives to data set folders: a pass over each file, one frame in memory, resumable.

::

    OUT/prepared.json                            what was asked for
    OUT/sequences/dataset1_keyframe1/            a data set folder: frames/, depth/, poses.txt, intrinsics.json
    OUT/keyframes/dataset1_keyframe1/            the measured keyframe, a data set folder of one frame

Every file is written beside and renamed into place, and ``intrinsics.json`` comes last, so a run that was interrupted
goes on where it stopped and a sequence with that file is whole.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import DatasetError, SettingsError
from bathyscope_train.data.datasets.depth_files import DepthCode, PointDepth, decode_image
from bathyscope_train.data.datasets.prepared_files import (
    DEPTH_SCALE_MM,
    encode_image,
    write_beside,
    write_intrinsics,
    write_poses,
)
from bathyscope_train.data.datasets.scared import published_shortfall
from bathyscope_train.data.datasets.scared_sequence import MOVED_DEPTH, open_keyframe, open_sequence
from bathyscope_train.data.datasets.scared_splits import frame_counts, sequence_order
from bathyscope_train.data.datasets.scared_tree import MARK, ScaredFolder, find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.datasets.tar_members import numbered_members
from bathyscope_train.evaluation.sequences import F32

_LEVELS = 65535
Progress = Callable[[str, int, int], None]


@dataclass
class Prepared:
    """What became of one sequence."""

    name: str
    frames: int = 0
    depth: int = 0
    new: int = 0
    """Files written in this run."""
    said: list[str] = field(default_factory=list)
    """What is missing or was left out, and what to know."""

    failed: bool = False
    """Whether it could not be read to its end."""

    @property
    def complete(self) -> bool:
        """Whether all published frames are there, each with a depth map."""
        published = frame_counts().get(self.name)
        return not self.failed if published is None else self.frames == self.depth == published


def prepare_scared(
    root: Path, out: Path, *, jpeg_quality: int | None = None, workers: int = 2, progress: Progress = lambda *_: None
) -> list[Prepared]:
    """Convert everything that is there; what was converted before stays.

    Args:
        root: The official tree, archives as they were fetched.
        out: Folder to write to.
        jpeg_quality: Frames as JPEG of this quality, a quarter of the size; PNG unless given.
        workers: Sequences at the same time; each holds a few frames in memory.
        progress: Told the sequence, and how many of how many frames are done.

    Returns:
        One entry for each of the 35 published sequences and any other that is there.

    Raises:
        DatasetError: If the root holds no SCARED. A sequence that cannot be read is said in its entry.
        SettingsError: If ``out`` was begun with other settings.
    """
    found = find_scared(root)
    out.mkdir(parents=True, exist_ok=True)
    _stamp(out, jpeg_quality)
    missing = [Prepared(name, said=["missing"]) for name in frame_counts() if name not in found]
    ending = ".png" if jpeg_quality is None else ".jpg"
    work = _Work(out, ending, jpeg_quality, progress)
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        done = list(pool.map(work.convert, found.values()))
    return sorted([*done, *missing], key=lambda entry: sequence_order(entry.name))


@dataclass(frozen=True)
class _Work:
    out: Path
    ending: str
    quality: int | None
    progress: Progress

    def convert(self, folder: ScaredFolder) -> Prepared:
        entry = Prepared(folder.name)
        try:
            self._keyframe(folder, entry)
            if folder.layout != "still":
                self._sequence(folder, entry)
        except DatasetError as error:
            entry.said.append(str(error))
            entry.failed = True
        except OSError as error:
            raise DatasetError(f"{self.out}: cannot write ({error.strerror}); mend that and run again") from error
        return entry

    def _sequence(self, folder: ScaredFolder, entry: Prepared) -> None:
        target = self.out / "sequences" / folder.name.replace("/", "_")
        if (target / "intrinsics.json").is_file():
            entry.frames, entry.depth = (len(list((target / part).iterdir())) for part in ("frames", "depth"))
            entry.said += _shortfall(folder.name, entry)
            return
        opened = open_sequence(folder)
        sequence = opened.sequence
        entry.said += opened.problems
        numbers = [int(name) for name in sequence.frame_names]
        for index, number in enumerate(numbers):
            path = target / "frames" / f"{number:06d}{self.ending}"
            if not path.is_file():
                self._image(path, sequence.image(index))
                entry.new += 1
            entry.frames += 1
            self.progress(f"{folder.name}: frames", index + 1, len(numbers))
        self._all_depth(folder, sequence, set(numbers), target, entry)
        write_poses(target / "poses.txt", sequence, self.ending)
        entry.said += write_intrinsics(target, sequence)
        entry.said += _shortfall(folder.name, entry)

    def _all_depth(
        self, folder: ScaredFolder, sequence: DataSequence, numbers: set[int], target: Path, entry: Prepared
    ) -> None:
        (target / "depth").mkdir(exist_ok=True)
        far = alone = 0
        for number, read in _depth_maps(folder, sequence):
            if number not in numbers:
                alone += 1
                continue
            path = target / "depth" / f"{number:06d}.png"
            if not path.is_file():
                far += self._depth(path, read(), sequence.size)
                entry.new += 1
            entry.depth += 1
            self.progress(f"{folder.name}: depth", entry.depth, len(numbers))
        if alone:
            entry.said.append(f"{alone} depth maps have no frame in the video; left out")
        if far:
            entry.said.append(f"{far} pixels farther than {_LEVELS * DEPTH_SCALE_MM:.0f} mm; written as unknown")

    def _keyframe(self, folder: ScaredFolder, entry: Prepared) -> None:
        still = open_keyframe(folder)
        target = self.out / "keyframes" / folder.name.replace("/", "_")
        if still is None:
            entry.said.append("no Left_Image.png with left_depth_map.tiff: the measured keyframe is missing")
        elif not (target / "intrinsics.json").is_file():
            self._image(target / "frames" / "000000.png", still.image(0))
            depth = still.truth(0)
            assert depth is not None
            self._depth(target / "depth" / "000000.png", depth, still.size)
            entry.new += 2
            entry.said += write_intrinsics(target, still)

    def _image(self, path: Path, image: NDArray[np.uint8]) -> None:
        import cv2

        options = [] if self.quality is None or path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, self.quality]
        write_beside(path, encode_image(path.suffix, image[..., ::-1], options))

    def _depth(self, path: Path, depth: F32, size: tuple[int, int]) -> int:
        """Write a depth map; returns the pixels that are too far for it."""
        if depth.shape != size:
            raise DatasetError(f"{path.stem}: depth of {depth.shape} for frames of {size}")
        steps = np.rint(depth / DEPTH_SCALE_MM)
        far = steps > _LEVELS
        write_beside(path, encode_image(".png", np.where(far, 0, steps).astype(np.uint16), []))
        return int(far.sum())


def _depth_maps(folder: ScaredFolder, sequence: DataSequence) -> Iterator[tuple[int, Callable[[], F32]]]:
    """Number and reader of every depth map, in whatever order they are stored."""
    place = folder.points
    if place is not None and place[0] == "tar":
        code: DepthCode = PointDepth("upper")
        for number, data in numbered_members(place[1], ".tiff"):
            where = f"{place[1]}, number {number}"
            yield number, lambda data=data, where=where: code.decode(decode_image(data, where), where)  # type: ignore[misc]
    else:
        for index, name in enumerate(sequence.frame_names):
            depth = sequence.truth(index)
            if depth is not None:
                yield int(name), lambda depth=depth: depth  # type: ignore[misc]


def _shortfall(name: str, entry: Prepared) -> list[str]:
    said = published_shortfall(name, entry.frames)
    without = entry.frames - entry.depth
    return ([said] if said else []) + ([f"{without} frames without depth"] if without else [])


def _stamp(out: Path, quality: int | None) -> None:
    values = {"dataset": "scared", "jpeg_quality": quality, "depth_scale_mm": DEPTH_SCALE_MM, "about": MOVED_DEPTH}
    text = json.dumps(values, indent=1) + "\n"
    if not (out / MARK).is_file():
        write_beside(out / MARK, text.encode())
    elif (out / MARK).read_text(encoding="utf-8") != text:
        raise SettingsError(f"{out / MARK}: begun with other settings; use the same --jpeg-quality, or another folder")

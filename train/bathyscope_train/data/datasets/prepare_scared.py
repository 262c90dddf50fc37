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
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.errors import DatasetError, SettingsError
from bathyscope_train.data.datasets.depth_files import DepthCode, PointDepth, decode_image
from bathyscope_train.data.datasets.scared import MOVED_DEPTH, open_keyframe, open_sequence, published_shortfall
from bathyscope_train.data.datasets.scared_splits import WRONG_CALIBRATION, dataset_number, frame_counts, sequence_order
from bathyscope_train.data.datasets.scared_tree import MARK, ScaredFolder, find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.datasets.tar_members import numbered_members
from bathyscope_train.evaluation.sequences import F32

DEPTH_SCALE_MM = 1 / 256
"""One step of the depth written; the farthest is 256 mm, and metrics stop at 150."""
AVERAGE_CAMERA = (0.82, 1.02, 0.5, 0.5)
"""fx / width, fy / height, cx / width, cy / height: the mean of all calibrations, used where a sequence has none."""
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
        _write_poses(target / "poses.txt", sequence, self.ending)
        _write_intrinsics(target, sequence, entry)
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
            _write_intrinsics(target, still, entry)

    def _image(self, path: Path, image: NDArray[np.uint8]) -> None:
        import cv2

        options = [] if self.quality is None or path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, self.quality]
        _write(path, _encode(path.suffix, image[..., ::-1], options))

    def _depth(self, path: Path, depth: F32, size: tuple[int, int]) -> int:
        """Write a depth map; returns the pixels that are too far for it."""
        if depth.shape != size:
            raise DatasetError(f"{path.stem}: depth of {depth.shape} for frames of {size}")
        steps = np.rint(depth / DEPTH_SCALE_MM)
        far = steps > _LEVELS
        _write(path, _encode(".png", np.where(far, 0, steps).astype(np.uint16), []))
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


def _write_poses(path: Path, sequence: DataSequence, ending: str) -> None:
    if sequence.world_from_camera is None:
        return
    lines = ["# file, then world_from_camera row by row; mm, x right, y down, z forward"]
    for name, pose in zip(sequence.frame_names, sequence.world_from_camera, strict=True):
        if np.isfinite(pose).all():
            lines.append(" ".join([name + ending, *(f"{value:.12g}" for value in pose.ravel())]))
    _write(path, ("\n".join(lines) + "\n").encode())


def _write_intrinsics(target: Path, sequence: DataSequence, entry: Prepared) -> None:
    height, width = sequence.size
    matrix, source = sequence.intrinsics, "calibration of the sequence, moved to the corner of the first pixel"
    if matrix is None:
        matrix, source = _average_camera(height, width), "none found; the mean of SCARED's calibrations"
        entry.said.append("no calibration (frame_data or endoscope_calibration.yaml); the mean of all is written")
    notes = list(sequence.notes)
    if dataset_number(sequence.name) in WRONG_CALIBRATION:
        entry.said.append("calibration known to be wrong (data sets 4 and 5)")
    values: dict[str, Any] = {
        "width": width,
        "height": height,
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
        "pixel_origin": "(0,0) is the top-left corner of the top-left pixel",
        "intrinsics_source": source,
        "depth": "uint16 PNG, z along the optical axis; depth_mm = value * depth_scale; 0 = nothing",
        "depth_scale": DEPTH_SCALE_MM,
        "depth_unit": "mm",
        "pose_unit": "mm" if sequence.world_from_camera is not None else None,
        "depth_valid": list(sequence.depth_range or (0, 150)),
        "notes": notes,
        "source": f"SCARED {sequence.name}, left eye, distorted and not rectified",
    }
    _write(target / "intrinsics.json", (json.dumps(values, indent=1) + "\n").encode())


def _average_camera(height: int, width: int) -> F64:
    fx, fy, cx, cy = AVERAGE_CAMERA
    return np.array([[fx * width, 0.0, cx * width], [0.0, fy * height, cy * height], [0.0, 0.0, 1.0]])


def _shortfall(name: str, entry: Prepared) -> list[str]:
    said = published_shortfall(name, entry.frames)
    without = entry.frames - entry.depth
    return ([said] if said else []) + ([f"{without} frames without depth"] if without else [])


def _encode(ending: str, image: NDArray[Any], options: list[int]) -> bytes:
    import cv2

    good, data = cv2.imencode(ending, np.ascontiguousarray(image), options)
    assert good
    return data.tobytes()


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_bytes(data)
    beside.replace(path)


def _stamp(out: Path, quality: int | None) -> None:
    values = {"dataset": "scared", "jpeg_quality": quality, "depth_scale_mm": DEPTH_SCALE_MM, "about": MOVED_DEPTH}
    text = json.dumps(values, indent=1) + "\n"
    if not (out / MARK).is_file():
        _write(out / MARK, text.encode())
    elif (out / MARK).read_text(encoding="utf-8") != text:
        raise SettingsError(f"{out / MARK}: begun with other settings; use the same --jpeg-quality, or another folder")

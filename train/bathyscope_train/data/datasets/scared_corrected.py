"""SCARED-C: camera poses estimated anew, and depth that follows from them, laid over the official tree.

(SCARED-C here is *Corrected Camera Poses for Endoscopic Depth Estimation*, 2026; the benchmark of image corruptions
that uses the same name is another thing.) How its files are called has not been established, so they are brought into
one of these forms, a folder for each sequence, with the frames that were corrected and no others::

    CORRECTED/datasetD/keyframeK/
        poses.txt                   file name and 16 numbers, camera to world, row by row; mm
        frame_data/NAME000012.json  or: "camera-pose" as in the official files, world to camera
        depth/000012.png            uint16, depth_mm = value * depth_scale of intrinsics.json
        scene_points/NAME000012.tiff  or: points as in the official files

The number in a name is the frame's number in the archive, from 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthCode, GreyDepth, PointDepth, read_array
from bathyscope_train.data.datasets.frame_files import by_number
from bathyscope_train.data.datasets.scared_frame_data import read_frame_data, read_pose_table
from bathyscope_train.data.datasets.sequence import DepthReader
from bathyscope_train.evaluation.calibration import read_calibration
from bathyscope_train.evaluation.images import image_files
from bathyscope_train.evaluation.sequences import F32


@dataclass(frozen=True)
class Correction:
    """What SCARED-C says of one sequence."""

    poses: Mapping[int, F64]
    """``world_from_camera`` by number of the frame."""
    depth: Mapping[int, Path]
    code: DepthCode

    def __contains__(self, number: int) -> bool:
        """Whether a frame was corrected; where poses and depth are there, both are needed."""
        return all(number in known for known in (self.poses, self.depth) if known)

    def over(self, official: F64 | None, numbers: list[int]) -> F64 | None:
        """Poses (t, 4, 4): the corrected ones alone, for their world is not the official one; NaN elsewhere."""
        if not self.poses:
            return official
        return np.stack([self.poses.get(number, np.full((4, 4), np.nan)) for number in numbers])


@dataclass(frozen=True)
class OverlaidDepth:
    """Corrected depth where there is some, the official one elsewhere."""

    official: DepthReader | None
    correction: Correction
    numbers: tuple[int, ...]
    size: Size

    def read(self, index: int) -> F32 | None:
        """True depth of a frame."""
        path = self.correction.depth.get(self.numbers[index])
        if path is None:
            return None if self.official is None else self.official.read(index)
        depth = self.correction.code.decode(read_array(path), str(path))
        if depth.shape != self.size:
            raise DatasetError(f"{path}: corrected depth {depth.shape} for frames of {self.size}")
        return depth


def read_corrections(root: Path) -> dict[str, Correction]:
    """The corrections of every sequence in a folder.

    Raises:
        DatasetError: If there is none, or a file cannot be read.
    """
    found: dict[str, Correction] = {}
    for path in sorted(root.glob("dataset*/keyframe*")):
        name = f"{path.parent.name.replace('_', '')}/{path.name.replace('_', '')}"
        found[name] = _read(path)
    if not found:
        raise DatasetError(f"{root}: no corrections; expected datasetD/keyframeK/ with poses.txt or frame_data/")
    return found


def _read(path: Path) -> Correction:
    poses = _poses(path)
    code: DepthCode
    if (path / "depth").is_dir():
        scale = read_calibration(path / "intrinsics.json").depth_scale
        if scale is None:
            raise DatasetError(f"{path / 'intrinsics.json'}: depth/ needs depth_scale")
        depth, code = by_number(image_files(path / "depth")), GreyDepth(scale)
    else:
        depth, code = by_number(list((path / "scene_points").glob("*.tif*"))), PointDepth("upper")
    if not poses and not depth:
        raise DatasetError(f"{path}: neither poses (poses.txt, frame_data/) nor depth (depth/, scene_points/)")
    return Correction(poses, depth, code)


def _poses(path: Path) -> dict[int, F64]:
    if (path / "poses.txt").is_file():
        return read_pose_table(path / "poses.txt")
    if not (path / "frame_data").is_dir():
        return {}
    poses, problems = read_frame_data(path / "frame_data")
    if problems:
        raise DatasetError(problems[0])
    return {number: data.world_from_camera for number, data in poses.items()}

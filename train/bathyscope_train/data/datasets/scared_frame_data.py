"""SCARED's poses and calibrations: ``frame_data*.json`` of each frame, ``endoscope_calibration.yaml`` of a keyframe."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, invert_pose
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.frame_files import number_in
from bathyscope_train.data.datasets.tar_members import numbered_members
from bathyscope_train.evaluation.folders import parse_pose

HALF_PIXEL = 0.5
"""OpenCV calibrates with the centre of the first pixel at 0; here it is at 0.5."""


@dataclass(frozen=True)
class FrameData:
    """One frame's json."""

    world_from_camera: F64
    """(4, 4); the file's ``camera-pose`` is its inverse, in mm."""
    intrinsics: F64 | None
    """(3, 3) of the left eye, origin at the corner of the first pixel."""


def read_frame_data(source: Path) -> tuple[dict[int, FrameData], list[str]]:
    """The jsons in a folder or a ``tar.gz``, or ``poses.txt``, by number; and what cannot be used, in words.

    Raises:
        DatasetError: If the archive is damaged.
    """
    if source.suffix == ".txt":
        return {number: FrameData(pose, None) for number, pose in read_pose_table(source).items()}, []
    found: dict[int, FrameData] = {}
    problems: list[str] = []
    for number, where, data in _documents(source):
        try:
            found[number] = parse_frame_data(data, where)
        except DatasetError as error:
            problems.append(str(error))
    return dict(sorted(found.items())), problems


def parse_frame_data(data: bytes, where: str) -> FrameData:
    """The parts of a json that are used.

    ``camera-pose`` is taken as camera-from-world, as the field's evaluators do; ``bathyscope data check`` measures
    whether depth carried from frame to frame agrees.

    Raises:
        DatasetError: If it is no json, or has no rigid pose.
    """
    try:
        values = json.loads(data)
        camera_from_world = np.array(values["camera-pose"], np.float64)
        left = values.get("camera-calibration", {}).get("KL")
        intrinsics = None if left is None else corner_intrinsics(np.array(left, np.float64), where)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{where}: not a frame_data json with a camera-pose ({error!r})") from error
    if camera_from_world.shape != (4, 4) or not _rigid(camera_from_world):
        raise DatasetError(f"{where}: its camera-pose is no rigid 4x4 matrix")
    return FrameData(invert_pose(camera_from_world), intrinsics)


def corner_intrinsics(matrix: F64, where: str) -> F64:
    """OpenCV's camera matrix with the origin moved to the corner of the first pixel.

    Raises:
        DatasetError: If it is none.
    """
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise DatasetError(f"{where}: not a camera matrix: {matrix.tolist()}")
    moved = matrix.copy()
    moved[:2, 2] += HALF_PIXEL
    return moved


def read_calibration_yaml(path: Path) -> F64 | None:
    """``M1`` of ``endoscope_calibration.yaml``; ``None`` where there is no such file.

    Raises:
        DatasetError: If it is there and holds no ``M1``.
    """
    import cv2

    if not path.is_file():
        return None
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        matrix = storage.getNode("M1").mat()
        storage.release()
    except (cv2.error, SystemError) as error:
        raise DatasetError(f"{path}: not a calibration that OpenCV reads ({error})") from error
    if matrix is None:
        raise DatasetError(f"{path}: it has no camera matrix M1")
    return corner_intrinsics(np.asarray(matrix, np.float64), str(path))


def read_pose_table(path: Path) -> dict[int, F64]:
    """``poses.txt``: file name and the 16 numbers of ``world_from_camera``; by the number in the name.

    Raises:
        DatasetError: If a line is none.
    """
    found: dict[int, F64] = {}
    for line, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = text.split("#")[0].split()
        if words:
            found[number_in(Path(words[0]))] = parse_pose(words[1:], f"{path}, line {line}")
    return found


def pose_array(poses: Mapping[int, FrameData], numbers: list[int]) -> F64 | None:
    """Poses (t, 4, 4) of the frames of these numbers, NaN for those without; ``None`` where no frame has one."""
    if not poses.keys() & set(numbers):
        return None
    return np.stack([poses[n].world_from_camera if n in poses else np.full((4, 4), np.nan) for n in numbers])


def _documents(source: Path) -> Iterator[tuple[int, str, bytes]]:
    if source.is_dir():
        for path in source.glob("*.json"):
            yield number_in(path), str(path), path.read_bytes()
    else:
        for number, data in numbered_members(source, ".json"):
            yield number, f"{source}, number {number}", data


def _rigid(pose: F64) -> bool:
    rotation = pose[:3, :3]
    return bool(
        np.isfinite(pose).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2)
        and np.linalg.det(rotation) > 0
        and np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6)
    )

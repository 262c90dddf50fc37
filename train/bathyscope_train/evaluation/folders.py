"""Data set folders: frames with dense or sparse depth, and poses where there are any.

::

    FOLDER/frames/NNNN.jpg|png   colour frames in video order
    FOLDER/intrinsics.json       width, height, fx, fy, cx, cy; depth_scale, depth_unit, pose_unit, depth_valid
    FOLDER/poses.txt             optional: file name and 16 numbers, camera to world, row-major
    FOLDER/depth/NNNN.png        z-depth, uint16; depth = value * depth_scale, 0 = no value
    FOLDER/sparse.npz            or: obs_frame, obs_uv, obs_depth, obs_flow_err_px, one row for each observation
    FOLDER/mask.png              optional: 255 inside the field of view
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.calibration import Calibration, check_size, read_calibration
from bathyscope_train.evaluation.images import image_files, read_colour, read_values
from bathyscope_train.evaluation.truth import TrueDepth, find_truth


@dataclass(frozen=True)
class DatasetFolder:
    """A checked folder."""

    path: Path
    frames: tuple[Path, ...]
    calibration: Calibration
    truth: TrueDepth
    world_from_camera: F64
    """(t, 4, 4), NaN for frames without a pose."""

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.path.resolve().name

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(t,) whether a frame has a pose."""
        return np.asarray(np.isfinite(self.world_from_camera).all(axis=(1, 2)))

    def image(self, index: int) -> NDArray[np.uint8]:
        """A frame as RGB (h, w, 3).

        Raises:
            DatasetError: If it cannot be read, or is not of the size in ``intrinsics.json``.
        """
        path = self.frames[index]
        image = read_colour(path)
        check_size(path, image.shape, self.calibration.size)
        return image

    @classmethod
    def open(cls, path: Path | str) -> DatasetFolder:
        """Read everything but the pixels.

        Raises:
            DatasetError: If something is missing, does not fit or cannot be read; names the file.
        """
        path = Path(path)
        frames = image_files(path / "frames")
        if not frames:
            raise DatasetError(f"{path / 'frames'}: no .jpg or .png frames; a data set folder holds them there")
        calibration = read_calibration(path / "intrinsics.json")
        mask = read_mask(path / "mask.png", calibration.size)
        return cls(
            path=path,
            frames=frames,
            calibration=calibration,
            truth=find_truth(path, frames, calibration, mask),
            world_from_camera=read_poses(path / "poses.txt", frames),
        )


def read_mask(path: Path, size: Size) -> NDArray[np.bool_]:
    """(h, w) inside the field of view: ``mask.png``, or everything where there is none."""
    if not path.is_file():
        return np.ones(size, np.bool_)
    values = read_values(path)
    check_size(path, values.shape, size)
    return np.asarray((values if values.ndim == 2 else values[..., 0]) > 127)


def read_poses(path: Path, frames: tuple[Path, ...]) -> F64:
    """``poses.txt`` as ``world_from_camera`` (t, 4, 4); NaN for frames without a pose."""
    poses = np.full((len(frames), 4, 4), np.nan)
    if not path.is_file():
        return poses
    index = {frame.name: number for number, frame in enumerate(frames)}
    for line, text in enumerate(path.read_text().splitlines(), 1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in index:
            raise DatasetError(f"{path}, line {line}: pose of {words[0]}, but there is no such file in frames/")
        poses[index[words[0]]] = parse_pose(words[1:], f"{path}, line {line}")
    return poses


def parse_pose(words: list[str], where: str) -> F64:
    """A rigid ``world_from_camera`` from 16 numbers, row by row.

    Raises:
        DatasetError: If they are none; names ``where`` they come from.
    """
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{where}: {error}") from error
    if len(values) != 16:
        raise DatasetError(f"{where}: a pose has 16 numbers after the file name, got {len(values)}")
    pose = np.array(values).reshape(4, 4)
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) or np.linalg.det(rotation) < 0:
        raise DatasetError(f"{where}: its upper left 3x3 is no rotation; poses are rigid camera-to-world matrices")
    return pose

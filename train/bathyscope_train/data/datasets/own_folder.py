"""Folders in Bathyscope's own layout to train on: true depth is not needed, and not read."""

from __future__ import annotations

from pathlib import Path

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.frame_files import ImageFiles, image_size
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.calibration import read_calibration
from bathyscope_train.evaluation.folder_sequences import known_unit
from bathyscope_train.evaluation.folders import read_mask, read_poses
from bathyscope_train.evaluation.images import image_files


def own_folders(root: Path) -> list[Path]:
    """``root`` if it holds ``frames/``, else the folders in it that do, or that have ``intrinsics.json``."""
    if (root / "frames").is_dir():
        return [root]
    children = sorted(path for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [path for path in children if (path / "frames").is_dir() or (path / "intrinsics.json").is_file()]


def open_own_folder(path: Path) -> DataSequence:
    """A folder in our own layout, with or without true depth; calibration, poses and mask where they are there.

    Raises:
        DatasetError: If it has no frames, or a file that is there cannot be used.
    """
    files = image_files(path / "frames")
    if not files:
        raise DatasetError(f"{path / 'frames'}: no .jpg or .png frames; a data set folder holds them there")
    stated = path / "intrinsics.json"
    calibration = read_calibration(stated) if stated.is_file() else None
    size = image_size(files[0]) if calibration is None else calibration.size
    table = path / "poses.txt"
    poses = read_poses(table, files) if table.is_file() else None
    mask = read_mask(path / "mask.png", size) if (path / "mask.png").is_file() else None
    return DataSequence(
        name=path.resolve().name,
        frames=ImageFiles(files),
        frame_names=[file.stem for file in files],
        size=size,
        intrinsics=None if calibration is None else calibration.matrix,
        world_from_camera=poses,
        pose_unit=None if poses is None or calibration is None else known_unit(calibration.pose_unit),
        inside=mask,
    )

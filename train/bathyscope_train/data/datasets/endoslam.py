"""EndoSLAM, synthetic part (Unity): frames and poses.

::

    ROOT/ORGAN/Frames/image_NNNN.png               320x320
              /Pixelwise Depths/aov_image_NNNN.png grey levels of the renderer, without a stated unit
              /Poses/*.csv                         tx, ty, tz, qx, qy, qz, qw, time; a header

Its depth pictures are grey levels between 0 and 1 of unstated range and direction, and users of the set found them
shifted against the frames. They are no ground truth here unless the caller states a scale. The real part has no dense
depth for each frame.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, quaternion_to_matrix
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthFiles, GreyDepth
from bathyscope_train.data.datasets.frame_files import ImageFiles, by_number, image_size
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.images import image_files
from bathyscope_train.evaluation.sequences import EvaluationSet, Gap

DEPTH_FOLDER = "Pixelwise Depths"
_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def endoslam_organs(root: Path) -> list[Path]:
    """Folders with ``Frames/`` and ``Pixelwise Depths/``: ``root``, or up to two levels below."""
    places = [root, *root.glob("*/"), *root.glob("*/*/")]
    return sorted({p for p in places if (p / "Frames").is_dir() and (p / DEPTH_FOLDER).is_dir()})


def is_endoslam(root: Path) -> bool:
    """Whether a folder looks like EndoSLAM's synthetic part."""
    return bool(endoslam_organs(root))


def open_endoslam(root: Path, *, depth_scale: float | None = None) -> EvaluationSet:
    """The sequences of a folder.

    Args:
        root: Folder.
        depth_scale: Depth of one grey level, where the caller knows it; without it there is no true depth.

    Raises:
        DatasetError: If there is none.
    """
    organs = endoslam_organs(root)
    if not organs:
        raise DatasetError(f"{root}: no EndoSLAM here; expected ORGAN/Frames/ and ORGAN/{DEPTH_FOLDER}/")
    opened = [_open(path, depth_scale) for path in organs]
    gaps = tuple(gap for _, problems in opened for gap in problems)
    words = f"{len(opened)} synthetic sequences of EndoSLAM"
    return EvaluationSet("endoslam", tuple(sequence for sequence, _ in opened), words, gaps)


def _open(folder: Path, depth_scale: float | None) -> tuple[DataSequence, list[Gap]]:
    images = by_number(image_files(folder / "Frames"))
    if not images:
        raise DatasetError(f"{folder / 'Frames'}: no frames")
    size = image_size(next(iter(images.values())))
    depth = {} if depth_scale is None else by_number(image_files(folder / DEPTH_FOLDER))
    poses, problem = _poses(folder / "Poses", len(images))
    gaps = [Gap(folder.name, "poses", problem)] if problem else []
    if depth_scale is None:
        gaps.append(Gap(folder.name, "", f"{DEPTH_FOLDER}/ states no unit and was found misaligned: no true depth"))
    sequence = DataSequence(
        name=folder.name,
        frames=ImageFiles(tuple(images.values())),
        frame_names=[f"{n:04d}" for n in images],
        size=size,
        depth=None if depth_scale is None else DepthFiles(_by_index(images, depth), GreyDepth(depth_scale), size),
        world_from_camera=poses,
        pose_unit=None if poses is None else "arbitrary",
        notes=("depth is grey levels of unstated range; users found it shifted against the frames",),
    )
    return sequence, gaps


def _by_index(images: dict[int, Path], depth: dict[int, Path]) -> dict[int, Path]:
    return {index: depth[number] for index, number in enumerate(images) if number in depth}


def _poses(folder: Path, frames: int) -> tuple[F64 | None, str | None]:
    """``world_from_camera`` (t, 4, 4), the n-th line for the n-th frame; and what does not fit."""
    path = next(iter(sorted(folder.glob("*.csv"))), None) if folder.is_dir() else None
    if path is None:
        return None, f"{folder}: no csv; no poses"
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    try:
        table = np.array([[float(row[name]) for name in _COLUMNS] for row in rows]).reshape(-1, len(_COLUMNS))
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: expected a header and columns {', '.join(_COLUMNS)} ({error!r})") from error
    if len(table) == 0:
        return None, f"{path}: no poses in it"
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = quaternion_to_matrix(table[:, [6, 3, 4, 5]])
    poses[:, :3, 3] = table[:, :3]
    # Unity's camera looks along +z with y up, left-handed. Turning z of the camera (the set's own advice) makes it
    # OpenGL's; turning y and z of that makes it ours; together y, and y of the world keeps rotations proper.
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    poses = flip @ poses @ flip
    filled = np.full((frames, 4, 4), np.nan)
    filled[: len(poses)] = poses[:frames]
    return filled, f"{path}: {len(poses)} poses for {frames} frames" if len(poses) != frames else None

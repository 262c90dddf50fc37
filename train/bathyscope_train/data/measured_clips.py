"""Clips of measured sequences at the network's size, for validation while a network trains."""

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.windows import TruthClip
from bathyscope_train.evaluation.folder_sequences import known_unit
from bathyscope_train.evaluation.folders import DatasetFolder
from bathyscope_train.evaluation.sequences import MILLIMETRES

_LENGTH = 16


def read_measured_clips(
    folder: Path, *, size: Size = (112, 140), limit: int = 8, length: int = _LENGTH
) -> list[TruthClip]:
    """Clips spread evenly over a data set folder, cut around the principal point to the shape of ``size``.

    A pixel's true depth is that of the observation nearest to its centre, 0 where there is none: dense maps and
    sparse points alike.

    Args:
        folder: In the layout of docs/conventions.md, with poses.
        size: (height, width) of the network's images.
        limit: At most so many clips.
        length: Consecutive frames of each.

    Raises:
        DatasetError: If the folder is not in that layout, or no run of frames has poses.
    """
    opened = DatasetFolder.open(folder)
    length = min(length, len(opened.frames))
    has_pose = opened.has_pose
    starts = [k for k in range(len(opened.frames) - length + 1) if has_pose[k : k + length].all()]
    if not starts:
        raise DatasetError(f"{folder}: no {length} frames in a row have poses; validation measures motion too")
    chosen = sorted({starts[round(k)] for k in np.linspace(0, len(starts) - 1, limit)})
    return [_clip(opened, range(start, start + length), size) for start in chosen]


def _clip(folder: DatasetFolder, index: range, size: Size) -> TruthClip:
    known = folder.calibration.matrix
    left, top, width, height = _centred_crop(known, folder.calibration.size, size)
    scale = size[1] / width
    images, depths = [], []
    for frame in index:
        image = folder.image(frame)[top : top + height, left : left + width]
        images.append(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA))
        seen = folder.truth.at(frame)
        rows = (seen.rows.astype(np.float64) + 0.5 - top) * size[0] / height
        columns = (seen.columns.astype(np.float64) + 0.5 - left) * scale
        depths.append(_nearest(rows, columns, seen.depth, size))
    poses = folder.world_from_camera[list(index)].copy()
    poses[:, :3, 3] *= _depth_units(folder)
    return TruthClip(
        frames=torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).contiguous(),
        depth=torch.from_numpy(np.stack(depths)),
        world_from_camera=torch.from_numpy(poses).float(),
        focal=float(known[0, 0] * scale),
        name=f"{folder.name}-{index[0]:04d}",
    )


def _depth_units(folder: DatasetFolder) -> float:
    """What a length of the poses is in units of the depth."""
    depth, pose = known_unit(folder.calibration.depth_unit), known_unit(folder.calibration.pose_unit)
    if depth == pose:
        return 1.0
    if depth not in MILLIMETRES or pose not in MILLIMETRES:
        raise DatasetError(f"{folder.path}: depth in {depth}, poses in {pose}; how one becomes the other is not known")
    return MILLIMETRES[pose] / MILLIMETRES[depth]


def _centred_crop(intrinsics: NDArray[np.float64], source: Size, size: Size) -> tuple[int, int, int, int]:
    """Left, top, width and height of the largest box about the principal point with the proportions of ``size``."""
    cx, cy = intrinsics[0, 2], intrinsics[1, 2]
    half = min(cx, source[1] - cx, min(cy, source[0] - cy) * size[1] / size[0])
    width = int(2 * half)
    height = int(width * size[0] / size[1])
    return round(cx - width / 2), round(cy - height / 2), width, height


def _nearest(
    rows: NDArray[np.float64], columns: NDArray[np.float64], depth: NDArray[np.float64], size: Size
) -> NDArray[np.float32]:
    """A map of ``size`` with the observation nearest to each pixel's centre."""
    result = np.zeros(size, np.float32)
    row, column = np.floor(rows).astype(int), np.floor(columns).astype(int)
    inside = (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    row, column, depth = row[inside], column[inside], depth[inside]
    far = np.hypot(rows[inside] - row - 0.5, columns[inside] - column - 0.5)
    order = np.argsort(-far, kind="stable")  # the nearest is written last
    result[row[order], column[order]] = depth[order]
    return result

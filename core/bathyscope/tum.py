"""Trajectories as TUM text: ``timestamp tx ty tz qx qy qz qw``, camera to world."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, matrix_to_quaternion, quaternion_to_matrix
from bathyscope.errors import ResultError


def tum_lines(timestamps_s: F64, world_from_camera: F64) -> Iterator[str]:
    """One line a camera, each ending in a newline; numbers keep double precision."""
    quaternions = matrix_to_quaternion(world_from_camera[:, :3, :3])
    for stamp, pose, (w, x, y, z) in zip(timestamps_s, world_from_camera, quaternions, strict=True):
        yield " ".join(repr(float(value)) for value in (stamp, *pose[:3, 3], x, y, z, w)) + "\n"


def read_tum(path: Path | str) -> tuple[F64, F64]:
    """Time stamps (t,) and ``world_from_camera`` (t, 4, 4) of a TUM file; lines starting with # are comments.

    Raises:
        ResultError: If a line does not hold eight numbers; names the line.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(Path(path).read_text().splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            values = [float(word) for word in line.split()]
        except ValueError as error:
            raise ResultError(f"{path}, line {number}: {error}") from error
        if len(values) != 8:
            raise ResultError(f"{path}, line {number}: a TUM line has 8 numbers, got {len(values)}")
        rows.append(values)
    table = np.array(rows, np.float64).reshape(-1, 8)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    if len(table):
        poses[:, :3, :3] = quaternion_to_matrix(table[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = table[:, 1:4]
    return table[:, 0], poses

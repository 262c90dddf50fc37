"""``intrinsics.json`` of a data set folder: size, camera, units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, PositiveFloat, PositiveInt, ValidationError

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError


class Calibration(BaseModel, frozen=True):
    """``intrinsics.json``; further fields are notes for people."""

    width: PositiveInt
    height: PositiveInt
    fx: PositiveFloat
    fy: PositiveFloat
    cx: float
    cy: float
    depth_scale: PositiveFloat | None = None
    depth_unit: str | None = None
    pose_unit: str | None = None
    depth_valid: tuple[float, float] | None = None

    @property
    def size(self) -> Size:
        """(height, width)."""
        return self.height, self.width

    @property
    def matrix(self) -> F64:
        """(3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


def check_size(path: Path, shape: tuple[int, ...], size: Size) -> None:
    """Refuse an image that is not of the stated size."""
    if shape[:2] != size:
        raise DatasetError(f"{path}: {shape[1]}x{shape[0]} pixels, intrinsics.json says {size[1]}x{size[0]}")


def read_calibration(path: Path) -> Calibration:
    """Read ``intrinsics.json``.

    Raises:
        DatasetError: If it is missing or cannot be used; names the field.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: missing; a data set folder states size and intrinsics there")
    try:
        calibration = Calibration.model_validate_json(path.read_bytes())
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'file'}: {e['msg']}" for e in error.errors())
        raise DatasetError(f"{path}: {problems}") from error
    valid = calibration.depth_valid
    if valid is not None and not valid[0] < valid[1]:
        raise DatasetError(f"{path}: depth_valid runs from low to high, got {list(valid)}")
    return calibration

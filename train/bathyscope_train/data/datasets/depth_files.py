"""True depth that lies in files: PNG, TIFF, scene points, npy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.images import read_values
from bathyscope_train.evaluation.sequences import F32

Half = Literal["upper", "all"]


class DepthCode(Protocol):
    """How depth is stored in a file."""

    def decode(self, values: Any, where: str) -> F32:
        """z-depth (h, w), 0 where unknown, of the stored values.

        Raises:
            DatasetError: If the values are not of this kind.
        """
        ...


@dataclass(frozen=True)
class GreyDepth:
    """A grey image: depth = value * scale; values of ``ceiling`` and more mean farther than the scale reaches."""

    scale: float
    ceiling: int | None = None

    def decode(self, values: Any, where: str) -> F32:
        """Integer values times the scale."""
        if values.ndim == 3 and values.shape[2] in {3, 4} and (values[..., :3] == values[..., :1]).all():
            values = values[..., 0]
        if values.ndim != 2 or values.dtype.kind not in "ui":
            raise DatasetError(f"{where}: depth must be a grey image of whole numbers, got {_kind(values)}")
        depth = values.astype(np.float32) * np.float32(self.scale)
        return depth if self.ceiling is None else np.where(values >= self.ceiling, np.float32(0), depth)


@dataclass(frozen=True)
class PointDepth:
    """SCARED's points: X, Y, Z in mm for each pixel; NaN and 0 both mean unknown.

    Attributes:
        half: ``upper`` for the sequences' files, which hold the right eye in the lower half.
        axis: Which channel is Z: 0 as OpenCV reads colour files (blue first), 2 in the order of the file.
    """

    half: Half
    axis: int = 0

    def decode(self, values: Any, where: str) -> F32:
        """The Z of every pixel."""
        if values.ndim != 3 or values.shape[2] != 3 or values.dtype.kind != "f":
            raise DatasetError(f"{where}: scene points are float images of 3 channels, got {_kind(values)}")
        depth = values[: values.shape[0] // 2] if self.half == "upper" else values
        return positive(np.ascontiguousarray(depth[..., self.axis], np.float32))


@dataclass(frozen=True)
class FloatDepth:
    """A float array of z-depth, or of X, Y, Z; in an npy file or a float image."""

    def decode(self, values: Any, where: str) -> F32:
        """The array, NaN made 0."""
        if values.ndim == 3 and values.shape[2] == 3:
            values = values[..., 2]
        if values.ndim != 2 or values.dtype.kind != "f":
            raise DatasetError(f"{where}: expected a float array of depth, got {_kind(values)}")
        return positive(values.astype(np.float32))


@dataclass(frozen=True)
class DepthFiles:
    """One file for each frame that has depth."""

    paths: Mapping[int, Path]
    """By index of the frame."""
    code: DepthCode
    size: Size

    def read(self, index: int) -> F32 | None:
        """True depth of a frame."""
        path = self.paths.get(index)
        if path is None:
            return None
        depth = self.code.decode(read_array(path), str(path))
        if depth.shape != self.size:
            (h, w), (height, width) = depth.shape, self.size
            raise DatasetError(f"{path}: depth of {w}x{h} pixels for frames of {width}x{height}")
        return depth


def read_array(path: Path) -> Any:
    """What a depth file holds: an array of ``.npy``, pixels of an image.

    Raises:
        DatasetError: If it is missing or damaged.
    """
    if not path.is_file():
        raise DatasetError(f"{path}: the depth file is missing")
    if path.suffix.lower() != ".npy":
        return read_values(path)
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: not an npy array ({error})") from error


def decode_image(data: bytes, where: str) -> Any:
    """Pixels of an image in memory, as stored but for OpenCV's order of colours.

    Raises:
        DatasetError: If it is no image.
    """
    import cv2

    image = cv2.imdecode(np.frombuffer(data or b"\0", np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"{where}: not a readable image ({len(data)} bytes)")
    return image


def positive(depth: F32) -> F32:
    """0 wherever depth is not a positive finite number."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _kind(values: Any) -> str:
    return f"{values.dtype} {values.shape}"

"""Predictions of one sequence: on disk while it is evaluated, so that memory holds one frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.errors import DatasetError, ResultError
from bathyscope_train.evaluation.frame_pixels import FrameValues, Quantity
from bathyscope_train.evaluation.sequences import MILLIMETRES
from bathyscope_train.systems.system import FrameEstimate, SystemInfo

_VALUES, _MASKS, _CAMERAS, _FINISHED = "values.f32", "masks.bits", "cameras.npz", "finished.json"


class Estimates(Protocol):
    """What a system says of every frame of a sequence."""

    @property
    def segment(self) -> NDArray[np.int32]:
        """(t,) frames of one segment share world and scale."""
        ...

    @property
    def world_from_camera(self) -> F64 | None:
        """(t, 4, 4); ``None`` without cameras."""
        ...

    def __len__(self) -> int: ...

    def read(self, index: int) -> FrameValues:
        """One frame."""
        ...


@dataclass(frozen=True)
class ArrayEstimates:
    """Predictions in memory."""

    values: NDArray[np.float32]
    """(t, h, w)"""
    quantity: Quantity = "depth"
    valid: NDArray[np.bool_] | None = None
    world_from_camera: F64 | None = None

    @property
    def segment(self) -> NDArray[np.int32]:
        """One segment."""
        return np.zeros(len(self.values), np.int32)

    def __len__(self) -> int:
        return len(self.values)

    def read(self, index: int) -> FrameValues:
        """One frame; all of it is valid unless said otherwise."""
        valid = np.ones(self.values.shape[1:], np.bool_) if self.valid is None else self.valid[index]
        return FrameValues(self.values[index], valid, self.quantity)


@dataclass(frozen=True)
class StoredEstimates:
    """Predictions in a folder: float32 values and packed masks of all frames, and what goes with them."""

    folder: Path
    shape: tuple[int, int, int]
    """(t, h, w)"""
    quantity: Quantity
    segment: NDArray[np.int32]
    world_from_camera: F64 | None
    intrinsics: F64 | None = None
    """(t, 3, 3) at (h, w); ``None`` without cameras."""
    millimetres: float | None = None
    """In one unit of predicted depth; ``None`` for depth that is not metric."""

    def __len__(self) -> int:
        return self.shape[0]

    def read(self, index: int) -> FrameValues:
        """One frame; read from disk each time, so that no more than it is held."""
        _, h, w = self.shape
        packed = (h * w + 7) // 8
        values = np.fromfile(self.folder / _VALUES, np.float32, h * w, offset=4 * h * w * index).reshape(h, w)
        mask = np.fromfile(self.folder / _MASKS, np.uint8, packed, offset=packed * index)
        return FrameValues(
            values, np.unpackbits(mask, count=h * w).view(np.bool_).reshape(h, w), self.quantity, self.millimetres
        )


def open_estimates(folder: Path, key: str) -> StoredEstimates | None:
    """The predictions that :func:`store_estimates` finished under the same key; ``None`` if there are none.

    Raises:
        ResultError: If the folder says it is finished and cannot be read.
    """
    if not (folder / _FINISHED).is_file():
        return None
    try:
        about = json.loads((folder / _FINISHED).read_text())
        if about["key"] != key:
            return None
        t, h, w = about["shape"]
        sizes = {_VALUES: 4 * t * h * w, _MASKS: t * ((h * w + 7) // 8)}
        for name, size in sizes.items():
            if (found := (folder / name).stat().st_size) != size:
                raise ResultError(f"{folder / name}: {found} bytes, {size} belong there; remove the folder")
        with np.load(folder / _CAMERAS) as cameras:
            arrays = {name: np.array(cameras[name]) for name in cameras}
        quantity, unit, segment = about["quantity"], about["millimetres"], arrays["segment"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultError(f"{folder}: {error}; remove the folder to predict again") from error
    return StoredEstimates(
        folder, (t, h, w), quantity, segment, arrays.get("world_from_camera"), arrays.get("intrinsics"), unit
    )


def store_estimates(
    folder: Path, key: str, info: SystemInfo, shape: tuple[int, int, int], estimates: Iterable[FrameEstimate]
) -> Iterator[int]:
    """Write predictions as they come; iterate to the end, then they are finished.

    Args:
        folder: Where to; what it held is replaced.
        key: Says of what system and sequence these are.
        info: What the values are.
        shape: (t, h, w): how many frames there must be, and their size.
        estimates: Frames in order.

    Yields:
        The number of frames written so far.

    Raises:
        DatasetError: If frames are missing or of another size.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    cameras, count = _Cameras(), 0
    with (folder / _VALUES).open("wb") as values, (folder / _MASKS).open("wb") as masks:
        for estimate in estimates:
            if estimate.index != count or count >= shape[0] or estimate.values.shape != shape[1:]:
                raise DatasetError(
                    f"the system answered with frame {estimate.index} of size {estimate.values.shape}, where frame "
                    f"{count} of {shape[0]} of size {shape[1:]} was due"
                )
            values.write(np.ascontiguousarray(estimate.values, np.float32).data)
            masks.write(np.packbits(estimate.valid).data)
            cameras.add(estimate)
            count += 1
            yield count
    if count != shape[0]:
        raise DatasetError(f"{shape[0]} frames went in, {count} came back")
    np.savez(folder / _CAMERAS, **cameras.arrays())
    unit = None if info.unit is None else MILLIMETRES[info.unit]
    about = {"key": key, "quantity": info.quantity, "shape": shape, "millimetres": unit}
    (folder / _FINISHED).write_text(json.dumps(about))


@dataclass
class _Cameras:
    segment: list[int] = field(default_factory=list)
    poses: list[F64] = field(default_factory=list)
    intrinsics: list[F64] = field(default_factory=list)

    def add(self, estimate: FrameEstimate) -> None:
        self.segment.append(estimate.segment)
        if estimate.world_from_camera is not None:
            self.poses.append(estimate.world_from_camera)
        if estimate.intrinsics is not None:
            self.intrinsics.append(estimate.intrinsics)

    def arrays(self) -> dict[str, Any]:
        """Poses and intrinsics only if every frame has them."""
        frames = len(self.segment)
        arrays: dict[str, Any] = {"segment": np.array(self.segment, np.int32)}
        if len(self.poses) == frames:
            arrays["world_from_camera"] = np.stack(self.poses)
        if len(self.intrinsics) == frames:
            arrays["intrinsics"] = np.stack(self.intrinsics)
        return arrays

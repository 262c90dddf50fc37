"""True depth of a data set folder: dense maps or sparse points."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.calibration import Calibration, check_size
from bathyscope_train.evaluation.images import image_files, read_values

MAX_FLOW_ERROR_PX = 1.0
"""Sparse observations that optical flow contradicts by more than this are outliers of the reconstruction."""


@dataclass(frozen=True, slots=True)
class Observations:
    """True depth at some pixels of one frame."""

    rows: NDArray[np.intp]
    """(n,)"""
    columns: NDArray[np.intp]
    """(n,)"""
    depth: F64
    """(n,) positive z-depth in the unit of the folder."""


class TrueDepth(Protocol):
    """Where the true depth of a folder is."""

    @property
    def kind(self) -> str:
        """``dense`` or ``sparse``."""
        ...

    def at(self, index: int) -> Observations:
        """What is known of one frame; nothing is not an error."""
        ...


@dataclass(frozen=True)
class DenseDepth:
    """One depth PNG for each frame that has depth."""

    files: dict[int, Path]
    calibration: Calibration
    mask: NDArray[np.bool_]
    kind: str = "dense"

    def at(self, index: int) -> Observations:
        """Pixels inside mask and ``depth_valid`` (bounds excluded) that have a value."""
        path = self.files.get(index)
        if path is None:
            return _nothing()
        values = read_values(path)
        if values.ndim != 2 or values.dtype != np.uint16:
            raise DatasetError(f"{path}: depth must be 16-bit grey PNG, got {values.dtype} {values.shape}")
        check_size(path, values.shape, self.calibration.size)
        scale = self.calibration.depth_scale
        assert scale is not None
        depth = values * scale
        rows, columns = np.nonzero(self.mask & _in_range(depth, self.calibration))
        return Observations(rows, columns, depth[rows, columns])


@dataclass(frozen=True)
class SparseDepth:
    """Points of a reconstruction, observed in frames; rows sorted by frame."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    depth: F64
    starts: NDArray[np.intp]
    """(t + 1,) where the rows of each frame begin."""
    kind: str = "sparse"

    def at(self, index: int) -> Observations:
        """Pixels that hold an observation of the frame."""
        mine = slice(int(self.starts[index]), int(self.starts[index + 1]))
        return Observations(self.rows[mine], self.columns[mine], self.depth[mine])


def _in_range(depth: F64, calibration: Calibration) -> NDArray[np.bool_]:
    """Where depth is known and inside ``depth_valid``, bounds excluded."""
    low, high = calibration.depth_valid or (0.0, np.inf)
    return np.asarray((depth > max(low, 0.0)) & (depth < high))


def _nothing() -> Observations:
    return Observations(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))


def find_truth(path: Path, frames: tuple[Path, ...], calibration: Calibration, mask: NDArray[np.bool_]) -> TrueDepth:
    """The dense maps of a folder, or else its sparse points.

    Args:
        path: The data set folder.
        frames: Its frames in video order.
        calibration: Its ``intrinsics.json``.
        mask: (h, w) inside the field of view.

    Raises:
        DatasetError: If there is neither, or it does not belong to the frames; names the file.
    """
    dense, sparse = path / "depth", path / "sparse.npz"
    if dense.is_dir():
        if calibration.depth_scale is None or calibration.depth_unit is None:
            raise DatasetError(f"{path / 'intrinsics.json'}: depth/ needs depth_scale and depth_unit; one is null")
        return DenseDepth(_depth_files(dense, frames), calibration, mask)
    if sparse.is_file():
        return _read_sparse(sparse, len(frames), calibration, mask)
    raise DatasetError(f"{path}: no true depth: neither depth/ nor sparse.npz; nothing to evaluate against")


def _depth_files(folder: Path, frames: tuple[Path, ...]) -> dict[int, Path]:
    index = {frame.stem: number for number, frame in enumerate(frames)}
    files = {}
    for file in image_files(folder):
        if file.stem not in index:
            raise DatasetError(f"{file}: depth of a frame that is missing in frames/ (no {file.stem}.jpg or .png)")
        files[index[file.stem]] = file
    if not files:
        raise DatasetError(f"{folder}: no depth maps; they are called like the frames, NNNN.png")
    return files


def _read_sparse(path: Path, frames: int, calibration: Calibration, mask: NDArray[np.bool_]) -> SparseDepth:
    arrays = _load_arrays(path, ("obs_frame", "obs_uv", "obs_depth", "obs_flow_err_px"))
    frame, uv, depth = arrays["obs_frame"], arrays["obs_uv"], np.asarray(arrays["obs_depth"], np.float64)
    if uv.shape != (len(frame), 2) or depth.shape != frame.shape or arrays["obs_flow_err_px"].shape != frame.shape:
        raise DatasetError(f"{path}: obs_frame {frame.shape}, obs_uv {uv.shape}, obs_depth {depth.shape} do not match")
    if len(frame) and not (frame.min() >= 0 and frame.max() < frames):
        raise DatasetError(f"{path}: observations of frame {int(frame.max())}, but frames/ holds {frames}")
    inside = ((uv >= 0) & (uv < (mask.shape[1], mask.shape[0]))).all(axis=1)
    columns, rows = np.where(inside[:, None], uv, 0).astype(np.intp).T
    keep = (
        inside & mask[rows, columns] & _in_range(depth, calibration) & (arrays["obs_flow_err_px"] < MAX_FLOW_ERROR_PX)
    )
    if not keep.any():
        raise DatasetError(
            f"{path}: none of its {len(frame)} observations is inside mask.png and depth_valid and agrees with "
            f"optical flow (obs_flow_err_px < {MAX_FLOW_ERROR_PX:g})"
        )
    order = np.flatnonzero(keep)[np.argsort(frame[keep], kind="stable")]
    starts = np.searchsorted(frame[order], np.arange(frames + 1)).astype(np.intp)
    return SparseDepth(rows[order], columns[order], depth[order], starts)


def _load_arrays(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: not an npz with {', '.join(names)} ({error})") from error

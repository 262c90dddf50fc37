"""The result as a zip of 16-bit PNG, for tools that read pictures.

``depth/000000.png`` (uint16; depth = value * ``depth_scale`` of ``result.json``, 0 = nothing there), ``confidence/``
likewise, ``valid/`` (8 bits, 255 = valid), ``poses.txt`` (TUM, camera to world) and ``result.json`` with cameras,
time stamps and meta data; without ``confidence/`` or ``poses.txt`` where the network has no such thing. Depth is
rounded to one step of ``depth_scale``, a power of two and at most 1/32,768 of the clip's largest value; everything else
is kept exactly. Because the step is a power of two, reading a zip and writing it again changes nothing.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Iterable
from math import ceil, log2
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from bathyscope.camera import F64
from bathyscope.errors import ResultError
from bathyscope.png import decode_grey, encode_grey
from bathyscope.result import ClipDepth, FrameDepth, ResultMeta
from bathyscope.result_files import MAPS, NpzReader
from bathyscope.tum import tum_lines
from bathyscope.zip_errors import ZIP_ERRORS

_LEVELS = 65535
_EPOCH = (1980, 1, 1, 0, 0, 0)
MAX_JSON_BYTES = 1 << 28
MAX_PNG_BYTES = 1 << 29


class ZipFrame(BaseModel, frozen=True, extra="forbid"):
    """What ``result.json`` says of one frame."""

    timestamp_s: float
    segment: int
    world_from_camera: list[list[float]] | None
    intrinsics: list[list[float]] | None


class ZipIndex(BaseModel, frozen=True, extra="forbid"):
    """``result.json``."""

    depth_scale: float
    confidence_scale: float | None
    size: tuple[int, int]
    meta: ResultMeta
    frames: list[ZipFrame]


def write_zip(npz: Path | str, path: Path | str) -> Path:
    """Turn a result's npz into a zip, frame by frame in bounded memory.

    Raises:
        ResultError: If the npz is damaged.
    """
    with NpzReader(npz) as reader:
        return _write(lambda: reader, reader.meta, reader.size, Path(path))


def save_zip(path: Path | str, clip: ClipDepth) -> Path:
    """Write a result that is in memory."""
    return _write(lambda: (clip.frame(t) for t in range(len(clip))), clip.meta, clip.size, Path(path))


def load_zip(path: Path | str) -> ClipDepth:
    """Read a result.

    Raises:
        ResultError: If the file is damaged or not such a zip.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            index = ZipIndex.model_validate_json(_read(archive, "result.json", MAX_JSON_BYTES))
            frames = [_read_frame(archive, index, t) for t in range(len(index.frames))]
    except (KeyError, *ZIP_ERRORS) as error:
        raise ResultError(f"{path}: not a readable result zip ({error})") from error
    return ClipDepth.from_frames(frames, index.meta)


def _write(frames: Callable[[], Iterable[FrameDepth]], meta: ResultMeta, size: tuple[int, int], path: Path) -> Path:
    depth_scale, confidence_scale = _scales(frames())
    entries: list[ZipFrame] = []
    beside = path.with_name(path.name + ".part")
    try:
        with zipfile.ZipFile(beside, "w", zipfile.ZIP_STORED) as archive:
            for t, frame in enumerate(frames()):
                _add(archive, f"depth/{t:06d}.png", encode_grey(_quantise(frame.depth, depth_scale)))
                if frame.confidence is not None:
                    levels = _quantise(frame.confidence, confidence_scale or 1.0)
                    _add(archive, f"confidence/{t:06d}.png", encode_grey(levels))
                _add(archive, f"valid/{t:06d}.png", encode_grey(np.where(frame.valid, 255, 0).astype(np.uint8)))
                entries.append(_entry(frame))
            if "cameras" in meta.outputs:
                poses = np.array([entry.world_from_camera for entry in entries], np.float64)
                stamps = np.array([entry.timestamp_s for entry in entries], np.float64)
                _add(archive, "poses.txt", "".join(tum_lines(stamps, poses)).encode())
            index = ZipIndex(
                depth_scale=depth_scale, confidence_scale=confidence_scale, size=size, meta=meta, frames=entries
            )
            _add(archive, "result.json", json.dumps(index.model_dump(mode="json"), indent=1).encode())
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
    return path


def _scales(frames: Iterable[FrameDepth]) -> tuple[float, float | None]:
    """Steps of depth and confidence that hold the largest value of the clip."""
    depth = 0.0
    confidences: list[float] = []
    for frame in frames:
        depth = max(depth, float(frame.depth.max()))
        if frame.confidence is not None:
            confidences.append(float(frame.confidence.max()))
    return _power_of_two_step(depth), _power_of_two_step(max(confidences)) if confidences else None


def _power_of_two_step(largest: float) -> float:
    """The smallest power of two by which ``largest`` stays within the levels."""
    return 2.0 ** ceil(log2(largest / _LEVELS)) if largest > 0 else 1.0


def _quantise(values: NDArray[np.floating], scale: float) -> NDArray[np.uint16]:
    """Levels of values; what is above 0 stays above 0, because 0 means nothing there."""
    levels = np.rint(values.astype(np.float64) / scale)
    return np.where(values > 0, np.clip(levels, 1, _LEVELS), 0).astype(np.uint16)


def _entry(frame: FrameDepth) -> ZipFrame:
    return ZipFrame(
        timestamp_s=frame.timestamp_s,
        segment=frame.segment,
        world_from_camera=None if frame.world_from_camera is None else frame.world_from_camera.tolist(),
        intrinsics=None if frame.intrinsics is None else frame.intrinsics.tolist(),
    )


def _read_frame(archive: zipfile.ZipFile, index: ZipIndex, t: int) -> FrameDepth:
    entry = index.frames[t]
    maps: dict[str, Any] = {}
    for name in MAPS:
        if name == "confidence" and index.confidence_scale is None:
            continue
        image = decode_grey(_read(archive, f"{name}/{t:06d}.png", MAX_PNG_BYTES))
        if image.shape != index.size:
            raise ResultError(f"{name}/{t:06d}.png is {image.shape}, result.json says {index.size}")
        maps[name] = image
    return FrameDepth(
        index=t,
        timestamp_s=entry.timestamp_s,
        depth=(maps["depth"] * index.depth_scale).astype(np.float32),
        confidence=_confidence(maps.get("confidence"), index.confidence_scale),
        valid=maps["valid"] > 127,
        world_from_camera=_matrix(entry.world_from_camera),
        intrinsics=_matrix(entry.intrinsics),
        segment=entry.segment,
    )


def _confidence(levels: Any, scale: float | None) -> Any:
    return None if scale is None else (levels * scale).astype(np.float32)


def _matrix(rows: list[list[float]] | None) -> F64 | None:
    return None if rows is None else np.array(rows, np.float64)


def _read(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    info = archive.getinfo(name)
    if info.file_size > limit:
        raise ResultError(f"{name} unpacks to {info.file_size} bytes; at most {limit} are read")
    return archive.read(info)


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)

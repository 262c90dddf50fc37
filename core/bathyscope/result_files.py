"""Result files: npz, written and read frame by frame in bounded memory.

The npz is an ordinary uncompressed one (``numpy.load`` reads it): the arrays of
:class:`~bathyscope.result.ClipDepth` and ``meta``, a JSON string. Its members are stored, not compressed, so that one
frame can be read without the rest. The zip of 16-bit PNG is in :mod:`bathyscope.result_zip`.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zipfile
from array import array
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, Self

import numpy as np
from numpy.lib import format as npy
from pydantic import ValidationError

from bathyscope.camera import Size
from bathyscope.errors import GeometryError, ResultError
from bathyscope.result import ARRAY_NAMES, RESULT_FORMAT, ClipDepth, FrameDepth, ResultMeta, array_names
from bathyscope.zip_errors import ZIP_ERRORS

MAPS = ("depth", "confidence", "valid")
"""The arrays that have a value for each pixel, and so decide the size of the file."""
Precision = Literal["float32", "float16"]
MAX_RESULT_BYTES = 1 << 40
MAX_SMALL_BYTES = 1 << 28
"""Longest of the arrays that have one value, or one matrix, a frame."""
_KINDS = {"world_from_camera": "f", "intrinsics": "f", "timestamps_s": "f", "segment": "iu", "meta": "U"}
_COLUMN_SHAPES: dict[str, tuple[int, ...]] = {
    "world_from_camera": (4, 4),
    "intrinsics": (3, 3),
    "timestamps_s": (),
    "segment": (),
}
_FIELDS = {"timestamps_s": "timestamp_s"}
"""What an array of a clip is called in a frame, where that differs."""
_EPOCH = (1980, 1, 1, 0, 0, 0)


class NpzWriter:
    """Writes a result as its frames become final; memory does not grow with their number.

    Maps go to temporary files beside the target, which appears under its name only when it is whole. As a context
    manager it removes what is unfinished.
    """

    def __init__(self, path: Path | str, precision: Precision = "float32") -> None:
        self.path = Path(path)
        self._types = {"depth": np.dtype(precision), "confidence": np.dtype(precision), "valid": np.dtype(np.bool_)}
        self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}-", dir=self.path.parent))
        self._spools: dict[str, IO[bytes]] = {name: (self._folder / name).open("wb") for name in MAPS}
        # numbers in one growing block: an array of its own for each frame, alive between the large ones that come and
        # go, would cut the heap into holes that nothing fits (measured: 0.1 MB a frame)
        self._columns = {name: array("d") for name in _COLUMN_SHAPES}
        self._size: Size | None = None
        self._held: tuple[str, ...] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.abandon()

    def __len__(self) -> int:
        return len(self._columns["timestamps_s"])

    def append(self, frame: FrameDepth) -> None:
        """Add the next frame.

        Raises:
            GeometryError: If it is not of the size of the frames before, has not what they have, or its depth is not
                finite.
        """
        size = (frame.depth.shape[0], frame.depth.shape[1])
        held = tuple(name for name in ARRAY_NAMES if getattr(frame, _FIELDS.get(name, name)) is not None)
        if self._size not in (None, size):
            raise GeometryError(f"frame {frame.index} is {size}, the frames before are {self._size}")
        if self._held not in ((), held):
            raise GeometryError(f"frame {frame.index} has {held}, the frames before have {self._held}")
        if not np.isfinite(frame.depth).all():
            raise GeometryError(f"frame {frame.index} has depth that is not finite")
        self._size, self._held = size, held
        for name in held:
            values = getattr(frame, _FIELDS.get(name, name))
            if name in MAPS:
                self._spools[name].write(np.ascontiguousarray(values, self._types[name]).data)
            else:
                self._columns[name].extend(np.ravel(values).tolist())

    def close(self, meta: ResultMeta) -> Path:
        """Write the file and return its path.

        Raises:
            ResultError: If no frame was added, or ``meta.outputs`` are not what the frames had.
        """
        if self._size is None:
            raise ResultError(f"{self.path.name}: a result needs at least one frame, got none")
        if self._held != array_names(meta.outputs):
            raise ResultError(f"{self.path.name}: its frames have {self._held}, its meta data says {meta.outputs}")
        for spool in self._spools.values():
            spool.close()
        whole = self._folder / "whole.npz"
        with zipfile.ZipFile(whole, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name in self._held:
                self._write_array(archive, name)
            _write_npy(archive, "meta", np.array(meta.model_dump_json()))
        with whole.open("rb") as file:
            os.fsync(file.fileno())
        whole.replace(self.path)
        self.abandon()
        return self.path

    def abandon(self) -> None:
        """Remove what is unfinished; nothing after :meth:`close`."""
        for spool in self._spools.values():
            spool.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _column(self, name: str) -> Any:
        """The values of all frames that are not maps."""
        values = np.array(self._columns[name], np.int32 if name == "segment" else np.float64)
        return values.reshape(-1, *_COLUMN_SHAPES[name])

    def _write_array(self, archive: zipfile.ZipFile, name: str) -> None:
        if name not in MAPS:
            _write_npy(archive, name, self._column(name))
            return
        assert self._size is not None
        shape = (len(self), *self._size)
        with _member(archive, name) as target, (self._folder / name).open("rb") as spool:
            header = {"descr": npy.dtype_to_descr(self._types[name]), "fortran_order": False, "shape": shape}
            npy.write_array_header_1_0(target, header)
            shutil.copyfileobj(spool, target, 1 << 20)


class NpzReader:
    """Reads a result frame by frame.

    Raises:
        ResultError: If the file is damaged, of a newer format, or would be larger than it can be.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._archive = zipfile.ZipFile(self.path)
        except ZIP_ERRORS as error:
            raise ResultError(f"{self.path}: not a readable npz file ({error})") from error
        try:
            self.meta = _parse_meta(str(self._small("meta")), self.path.name)
            held = array_names(self.meta.outputs)
            self._headers = {name: self._header(name) for name in MAPS if name in held}
            self._columns = {name: self._small(name) for name in held if name not in MAPS}
            self._check()
        except BaseException:
            self._archive.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._archive.close()

    def __len__(self) -> int:
        return int(self._headers["depth"][0][0])

    @property
    def size(self) -> Size:
        """(height, width) of the source."""
        _, h, w = self._headers["depth"][0]
        return h, w

    def __iter__(self) -> Iterator[FrameDepth]:
        """The frames in order; only one is in memory at a time."""
        spools = {name: self._open(name) for name in self._headers}
        try:
            for name, spool in spools.items():
                _read_header(spool, self.path.name, name)
            for t in range(len(self)):
                yield self._frame(t, {name: self._next_map(name, spools[name]) for name in self._headers})
        finally:
            for spool in spools.values():
                spool.close()

    def load(self) -> ClipDepth:
        """The whole clip in memory."""
        return ClipDepth.from_frames(list(self), self.meta)

    def _frame(self, t: int, maps: dict[str, Any]) -> FrameDepth:
        return FrameDepth(
            index=t,
            timestamp_s=float(self._columns["timestamps_s"][t]),
            depth=maps["depth"],
            confidence=maps.get("confidence"),
            valid=maps["valid"],
            world_from_camera=self._matrix("world_from_camera", t),
            intrinsics=self._matrix("intrinsics", t),
            segment=int(self._columns["segment"][t]),
        )

    def _matrix(self, name: str, t: int) -> Any:
        return self._columns[name][t] if name in self._columns else None

    def _next_map(self, name: str, spool: IO[bytes]) -> Any:
        (_, h, w), dtype = self._headers[name]
        try:
            data = spool.read(h * w * dtype.itemsize)
        except ZIP_ERRORS as error:
            raise ResultError(f"{self.path.name}: {name} is damaged ({error})") from error
        if len(data) != h * w * dtype.itemsize:
            raise ResultError(f"{self.path.name}: {name} ends early")
        return np.frombuffer(data, dtype).reshape(h, w)

    def _open(self, name: str) -> IO[bytes]:
        try:
            return self._archive.open(f"{name}.npy")
        except KeyError as error:
            raise ResultError(f"{self.path.name}: no array {name!r}; not a result of bathyscope") from error
        except ZIP_ERRORS as error:
            raise ResultError(f"{self.path.name}: {name} is damaged ({error})") from error

    def _header(self, name: str) -> tuple[tuple[int, int, int], np.dtype[Any]]:
        with self._open(name) as member:
            shape, dtype = _read_header(member, self.path.name, name)
        if len(shape) != 3 or min(shape) < 1 or dtype.kind not in "fb":
            raise ResultError(f"{self.path.name}: {name} must be (t, h, w) numbers, got {dtype} {shape}")
        stored = self._archive.getinfo(f"{name}.npy").file_size
        if int(np.prod(shape, dtype=object)) * dtype.itemsize > min(stored, MAX_RESULT_BYTES):
            raise ResultError(f"{self.path.name}: {name} claims shape {shape} but holds {stored} bytes")
        return (shape[0], shape[1], shape[2]), dtype

    def _small(self, name: str) -> Any:
        """A whole array; its size is checked before it takes memory."""
        with self._open(name) as member:
            shape, dtype = _read_header(member, self.path.name, name)
        stored = self._archive.getinfo(f"{name}.npy").file_size
        claimed = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if dtype.kind not in _KINDS[name] or claimed > min(stored, MAX_SMALL_BYTES):
            raise ResultError(f"{self.path.name}: {name} is {dtype} {shape} in {stored} bytes, which no result has")
        with self._open(name) as member:
            try:
                return npy.read_array(member, allow_pickle=False)
            except ZIP_ERRORS as error:
                raise ResultError(f"{self.path.name}: {name} is damaged ({error})") from error

    def _check(self) -> None:
        t, h, w = self._headers["depth"][0]
        wanted = {name: (t, *_COLUMN_SHAPES[name]) for name in self._columns}
        found = {name: self._columns[name].shape for name in wanted}
        if found != wanted or any(shape != (t, h, w) for shape, _ in self._headers.values()):
            raise ResultError(f"{self.path.name}: the arrays do not belong together: depth {(t, h, w)}, others {found}")


def save_npz(path: Path | str, clip: ClipDepth) -> Path:
    """Write a result; its depth keeps its precision."""
    precision: Precision = "float16" if clip.depth.dtype == np.float16 else "float32"
    with NpzWriter(path, precision) as writer:
        for t in range(len(clip)):
            writer.append(clip.frame(t))
        return writer.close(clip.meta)


def load_npz(path: Path | str) -> ClipDepth:
    """Read a result.

    Raises:
        ResultError: If the file is damaged or of a newer format.
    """
    with NpzReader(path) as reader:
        return reader.load()


def _member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    return archive.open(zipfile.ZipInfo(f"{name}.npy", _EPOCH), "w", force_zip64=True)


def _write_npy(archive: zipfile.ZipFile, name: str, array: Any) -> None:
    with _member(archive, name) as target:
        npy.write_array(target, np.asarray(array), allow_pickle=False)


def _read_header(member: IO[bytes], file: str, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    try:
        if npy.read_magic(member) != (1, 0):
            raise ValueError("unknown npy version")
        shape, fortran, dtype = npy.read_array_header_1_0(member)
    except (TypeError, *ZIP_ERRORS) as error:
        raise ResultError(f"{file}: {name} is damaged ({error})") from error
    if fortran:
        raise ResultError(f"{file}: {name} is in Fortran order; results are in C order")
    return shape, dtype


def _parse_meta(text: str, file: str) -> ResultMeta:
    try:
        found = json.loads(text).get("format", 0)
        if found > RESULT_FORMAT:
            raise ResultError(f"{file}: result format {found} is newer than this build reads; upgrade bathyscope")
        return ResultMeta.model_validate_json(text)
    except (ValidationError, ValueError, AttributeError, TypeError) as error:
        raise ResultError(f"{file}: its meta data cannot be read ({error})") from error

"""Frames from a decoding process of their own, and how to open anything as a source."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Self

import numpy as np

from bathyscope.camera import Size
from bathyscope.errors import ClipError
from bathyscope_serve.decode_limits import DecodeLimits
from bathyscope_serve.frames import Frame, SourceReport, Survey
from bathyscope_serve.pipe import END, ERROR, FRAME, HEADER, SURVEY, PipeReader

_PIPE_BYTES = 1 << 20
_KEPT_ENVIRONMENT = ("PATH", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TMPDIR")


class IsolatedSource:
    """A file or folder read by a child process; use as a context manager, or close it.

    Raises:
        ClipError: If not even one frame can be decoded.
    """

    def __init__(self, source: int | Path, name: str, limits: DecodeLimits) -> None:
        self._name = name
        self._report = SourceReport()
        self._process, descriptor = _start(source, name, limits)
        self._pipe_end = os.fdopen(descriptor, "rb", buffering=0)
        self._reader = PipeReader(descriptor, limits.wait_s)
        try:
            self._size, self.frame_count = self._header(limits)
            self._survey = self._first_look()
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        return self._name

    @property
    def size(self) -> Size:
        return self._size

    def survey(self) -> Survey:
        return self._survey

    def report(self) -> SourceReport:
        return self._report

    def __iter__(self) -> Iterator[Frame]:
        shape = (*self._size, 3)
        expected = 0
        while (message := self._reader.kind()) is not None:
            kind, length = message
            if kind == FRAME:
                content = self._reader.frame(length, shape)
                if content is None:
                    break
                index, timestamp_s, image = content
                if index != expected or not np.isfinite(timestamp_s):
                    raise ClipError(f"{self._name}: the decoder sent frame {index} at {timestamp_s} s after {expected}")
                expected += 1
                yield Frame(index, timestamp_s, image)
            elif kind == END:
                end = self._reader.json(length)
                self._report.complete = bool(end["complete"])
                self._report.warnings += [str(warning) for warning in end["warnings"]]
                return
            else:
                raise ClipError(self._message(kind, length))
        self._report.complete = False
        self._report.warnings.append(f"the decoder broke off after {expected} frames ({self._fate()})")

    def close(self) -> None:
        """Kill the decoder with everything it may have started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._pipe_end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _header(self, limits: DecodeLimits) -> tuple[Size, int | None]:
        message = self._reader.kind()
        if message is None:
            raise ClipError(f"{self._name}: the decoder broke off before the first frame ({self._fate()})")
        kind, length = message
        if kind != HEADER:
            raise ClipError(self._message(kind, length))
        header = self._reader.json(length)
        h, w = (int(side) for side in header["size"])
        if not (0 < h <= limits.side_pixels and 0 < w <= limits.side_pixels and h * w <= limits.frame_pixels):
            raise ClipError(f"{self._name}: the decoder announced frames of {w}x{h}")
        self._surveyed = max(1, int(header["surveyed"]))
        count = header["frame_count"]
        return (h, w), None if count is None else int(count)

    def _first_look(self) -> Survey:
        message = self._reader.kind()
        content = self._reader.frame(message[1], self._size) if message is not None and message[0] == SURVEY else None
        if content is None:
            raise ClipError(f"{self._name}: the decoder broke off before the first frame ({self._fate()})")
        return Survey(content[2], self._surveyed)

    def _message(self, kind: int, length: int) -> str:
        if kind == ERROR:
            return str(self._reader.json(length)["message"])
        return f"{self._name}: the decoder sent a message of unknown kind {kind}"

    def _fate(self) -> str:
        try:
            code = self._process.wait(5)
        except subprocess.TimeoutExpired:
            return "it closed its pipe"
        if code == -signal.SIGXCPU:
            return "its CPU time was used up"
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def open_source(
    source: Path | str | BinaryIO, *, name: str | None = None, limits: DecodeLimits | None = None
) -> IsolatedSource:
    """Open a video, a zip of images, or a folder of images, whatever its content says it is.

    Args:
        source: Path of a file or folder, or an open binary file, which is not needed any more after the call.
        name: What messages call it; the path's stem unless given.
        limits: What it may ask for.

    Raises:
        ClipError: If it does not exist or no frame can be decoded.
    """
    limits = limits or DecodeLimits()
    if isinstance(source, str | Path):
        path = Path(source)
        name = name or path.stem
        if path.is_dir():
            return IsolatedSource(path.resolve(), name, limits)
        if not path.is_file():
            raise ClipError(f"{path}: no such file or folder")
        with path.open("rb") as file:
            return IsolatedSource(file.fileno(), name, limits)
    with tempfile.TemporaryFile(prefix="bathyscope-clip-") as spool:
        source.seek(0)
        shutil.copyfileobj(source, spool, 1 << 20)
        spool.flush()
        return IsolatedSource(spool.fileno(), name or "clip", limits)


def _start(source: int | Path, name: str, limits: DecodeLimits) -> tuple[subprocess.Popen[bytes], int]:
    """The decoding process, as the leader of its own group, and the descriptor to read from."""
    read_end, write_end = os.pipe()
    if hasattr(fcntl, "F_SETPIPE_SZ"):
        with contextlib.suppress(OSError):  # a user may have used up its share of pipe memory; slower, not wrong
            fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    job = {
        "folder": str(source) if isinstance(source, Path) else None,
        "descriptor": None if isinstance(source, Path) else source,
        "pipe": write_end,
        "name": name,
        "limits": limits.model_dump(),
    }
    passed = [write_end] if isinstance(source, Path) else [write_end, source]
    environment = {key: os.environ[key] for key in _KEPT_ENVIRONMENT if key in os.environ}
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "bathyscope_serve.decoder", json.dumps(job)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            env=environment | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
            pass_fds=passed,
            start_new_session=True,
        )
    except BaseException:
        os.close(read_end)
        raise
    finally:
        os.close(write_end)
    return process, read_end

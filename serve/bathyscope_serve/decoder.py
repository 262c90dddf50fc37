"""The decoding process: ``python -m bathyscope_serve.decoder``, with the file and a pipe as descriptors.

FFmpeg is C and its input comes from anybody: a file made for it may crash it or fill the memory. So it runs in a
process of its own that can be lost, with bounds on memory, CPU time, files and processes, and without the network
where the kernel allows it.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import sys
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bathyscope.errors import ClipError
from bathyscope_serve.decode_limits import DecodeLimits
from bathyscope_serve.frames import SURVEY_FRAMES
from bathyscope_serve.images import ImageReader, open_folder, open_zip
from bathyscope_serve.pipe import END, ERROR, HEADER, send_frame, send_json
from bathyscope_serve.regular_file import RegularFile
from bathyscope_serve.video import VideoReader

_CLONE_NEWNET, _CLONE_NEWUSER = 0x40000000, 0x10000000
_PR_SET_NO_NEW_PRIVS, _PR_SET_DUMPABLE = 38, 4


def confine(limits: DecodeLimits) -> None:
    """Give up what decoding does not need; everything that is imported must be imported by now."""
    libc = ctypes.CDLL(None, use_errno=True)
    if sys.platform == "linux":
        libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
        libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET)  # refused in many containers; the whitelists hold without it
    bounds = {
        resource.RLIMIT_AS: limits.memory_bytes,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_NOFILE: 64,
        resource.RLIMIT_NPROC: 0,
        resource.RLIMIT_CORE: 0,
    }
    # the soft limit tells by SIGXCPU what happened; the hard one kills whoever ignores it
    resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu_s, limits.cpu_s + 5))
    for kind, bound in bounds.items():
        resource.setrlimit(kind, (bound, bound))


def open_reader(source: int | Path, name: str, limits: DecodeLimits) -> VideoReader | ImageReader:
    """The reader that fits what the source holds.

    Raises:
        ClipError: If none does.
    """
    if isinstance(source, Path):
        return open_folder(source, name, limits)
    file = RegularFile(source)
    if file.length > limits.file_bytes:
        raise ClipError(f"{name}: {file.length} bytes; at most {limits.file_bytes} are read")
    is_zip = file.read(4) in (b"PK\x03\x04", b"PK\x05\x06")
    return open_zip(file, name, limits) if is_zip else VideoReader(file, name, limits)


def serve(source: int | Path, name: str, limits: DecodeLimits, pipe: BinaryIO) -> None:
    """Survey, header, frames and end; or the error that stopped it."""
    try:
        reader = open_reader(source, name, limits)
        survey, looked_at = None, 0
        for image in reader.survey():
            brightest = image.max(-1)
            if survey is None or survey.shape == brightest.shape:
                survey = brightest if survey is None else np.maximum(survey, brightest)
                looked_at += 1
            if looked_at == 2 * SURVEY_FRAMES:
                break
        size = None
        for index, decoded in enumerate(reader.frames()):
            if size is None:
                size = decoded.image.shape[:2]
                send_json(pipe, HEADER, {"size": size, "frame_count": reader.frame_count, "surveyed": looked_at})
                usable = survey is not None and survey.shape == size
                send_frame(pipe, 0, 0.0, survey if usable and survey is not None else decoded.image.max(-1))
            send_frame(pipe, index, decoded.timestamp_s, decoded.image)
        if size is None:
            detail = "; ".join(reader.tally.summary()) or "it holds none"
            raise ClipError(f"{name}: no frame could be decoded: {detail}")
        complete = reader.tally.complete and not reader.tally.corrupt
        send_json(pipe, END, {"complete": complete, "warnings": reader.tally.summary()[:20]})
    except ClipError as error:
        send_json(pipe, ERROR, {"message": str(error)[:4000]})
    except MemoryError:
        message = f"{name}: decoding it needs more than {limits.memory_bytes} bytes of memory"
        send_json(pipe, ERROR, {"message": message})


def main() -> None:
    """Run with a job in JSON as the one argument."""
    job = json.loads(sys.argv[1])
    limits = DecodeLimits.model_validate(job["limits"])
    source = Path(job["folder"]) if job["folder"] is not None else int(job["descriptor"])
    confine(limits)
    with os.fdopen(job["pipe"], "wb") as pipe:
        try:
            serve(source, job["name"], limits, pipe)
        except BrokenPipeError:
            os._exit(0)  # the reader has all it wanted; closing the pipe properly would raise again


if __name__ == "__main__":
    main()

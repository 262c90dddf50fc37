"""A clip's way from the wire to a temporary file: raw body or multipart, in bounded memory."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, BinaryIO

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect

from bathyscope_serve.problems import ProblemError

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

FIELD = "clip"
RAW_TYPES = ("application/zip", "application/x-zip-compressed", "application/octet-stream")
_FLUSH_BYTES = 1 << 20
_MAX_NAME = 100


class ClientGone(Exception):  # noqa: N818 - an event, not a mistake
    """The client closed the connection; nobody waits for an answer."""


async def receive_clip(request: Request, path: Path) -> str | None:
    """Write the clip of a request to ``path``.

    Returns:
        The name that the client gave the file, if any; for messages only, never a path.

    Raises:
        ProblemError: 415 for a content type that carries no clip, 400 for multipart that cannot be parsed or has no
            file in the field ``clip``, 422 for an empty file; 408 and 413 come from the body's limits.
        ClientGone: If the client left.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    content_type = kind.decode("latin-1").lower()
    try:
        with path.open("wb") as file:
            if content_type == "multipart/form-data":
                name = await _receive_multipart(request, options.get(b"boundary", b""), file)
            elif content_type.startswith("video/") or content_type in RAW_TYPES:
                name = await _receive_raw(request, file)
            else:
                raise _unsupported(content_type)
    except ClientDisconnect as error:
        raise ClientGone from error
    if path.stat().st_size == 0:
        raise ProblemError(422, "clip-unusable", "the clip is empty (0 bytes); send a video or a zip of images")
    return name


async def _receive_raw(request: Request, file: BinaryIO) -> str | None:
    sink = _Sink(file)
    async for chunk in request.stream():
        sink.add(chunk)
        await sink.flush_if_full()
    await sink.flush()
    return plain_name(request.query_params.get("name"))


async def _receive_multipart(request: Request, boundary: bytes, file: BinaryIO) -> str | None:
    form = _ClipForm(_Sink(file))
    try:
        parser = MultipartParser(boundary, form.callbacks())
        async for chunk in request.stream():
            parser.write(chunk)
            await form.sink.flush_if_full()
        parser.finalize()
    except FormParserError as error:
        raise ProblemError(400, "multipart-malformed", f"the multipart body cannot be parsed: {error}") from error
    if not form.finished:
        raise ProblemError(400, "multipart-malformed", f"the multipart body ends without a whole file in {FIELD!r}")
    await form.sink.flush()
    return plain_name(form.file_name)


class _Sink:
    """Gathers chunks and writes them off the event loop, a megabyte at a time."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._gathered = bytearray()

    def add(self, chunk: bytes) -> None:
        self._gathered += chunk

    async def flush_if_full(self) -> None:
        if len(self._gathered) >= _FLUSH_BYTES:
            await self.flush()

    async def flush(self) -> None:
        block, self._gathered = self._gathered, bytearray()
        await asyncio.to_thread(self._file.write, block)


class _ClipForm:
    """Follows a multipart parser: the data of the field ``clip`` goes to the sink, any other field is refused."""

    def __init__(self, sink: _Sink) -> None:
        self.sink = sink
        self.file_name: str | None = None
        self.finished = False
        self._header_name = bytearray()
        self._header_value = bytearray()
        self._disposition = b""

    def callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._header_name.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header_value.extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": lambda data, start, end: self.sink.add(data[start:end]),
            "on_part_end": self._end,
        }

    def _begin(self) -> None:
        if self.finished:
            raise ProblemError(400, "multipart-malformed", f"one request takes one clip; found a part after {FIELD!r}")
        self._disposition = b""

    def _header_end(self) -> None:
        if self._header_name.lower() == b"content-disposition":
            self._disposition = bytes(self._header_value)
        self._header_name.clear()
        self._header_value.clear()

    def _headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        field = options.get(b"name", b"").decode("utf-8", "replace")
        if field != FIELD:
            raise ProblemError(
                400, "multipart-malformed", f"found the field {field[:40]!r}; send the file in {FIELD!r} and no other"
            )
        self.file_name = options.get(b"filename", b"").decode("utf-8", "replace")

    def _end(self) -> None:
        self.finished = True


def plain_name(name: str | None) -> str | None:
    """A file name fit for messages and headers: no folders, no suffix, plain characters, not long."""
    if not name:
        return None
    last = PureWindowsPath(PurePosixPath(name).name).stem
    return re.sub(r"[^\w .()+-]", "_", last).strip(" .")[:_MAX_NAME] or None


def _unsupported(content_type: str) -> ProblemError:
    return ProblemError(
        415,
        "content-type-unsupported",
        f"found the content type {content_type[:60] or '(none)'!r}; send video/*, {', '.join(RAW_TYPES)}, "
        f"or multipart/form-data with the file in {FIELD!r}",
        headers={"Accept": f"video/*, {', '.join(RAW_TYPES)}, multipart/form-data"},
    )

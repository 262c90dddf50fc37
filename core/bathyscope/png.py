"""Grey PNG, 8 and 16 bits a pixel, with nothing but zlib.

Depth maps need one colourless, lossless 16-bit format that every tool reads. The writer predicts each row from the
one above (filter "up"), which suits smooth maps; the reader takes what common writers produce for such files.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import ResultError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_NONE, _SUB, _UP = 0, 1, 2
MAX_PIXELS = 1 << 28

Grey = NDArray[np.uint8] | NDArray[np.uint16]


def encode_grey(image: Grey, level: int = 1) -> bytes:
    """PNG file of an image (h, w), uint8 or uint16; ``level`` is zlib's, 1 being nearly as small as 9 on depth."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
        raise ResultError(f"a grey PNG needs a non-empty uint8 or uint16 (h, w) image, got {image.dtype} {image.shape}")
    h, w = image.shape
    width = image.dtype.itemsize
    rows = np.ascontiguousarray(image.astype(image.dtype.newbyteorder(">"))).view(np.uint8).reshape(h, w * width)
    filtered = np.empty((h, 1 + w * width), np.uint8)
    filtered[:, 0] = _UP
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])
    header = struct.pack(">IIBBBBB", w, h, 8 * width, 0, 0, 0, 0)
    body = zlib.compress(filtered.tobytes(), level)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def decode_grey(data: bytes) -> Grey:
    """Image (h, w) of a grey PNG file.

    Raises:
        ResultError: If the file is damaged, or uses colour, interlacing or row filters that no depth writer needs.
    """
    if data[:8] != _SIGNATURE:
        raise ResultError("not a PNG file")
    chunks = _chunks(data)
    if "IHDR" not in chunks or "IDAT" not in chunks or len(chunks["IHDR"]) != 13:
        raise ResultError("PNG without header or image data")
    w, h, bits, colour, _, _, interlace = struct.unpack(">IIBBBBB", chunks["IHDR"])
    if colour != 0 or bits not in (8, 16) or interlace != 0 or not 0 < w * h <= MAX_PIXELS:
        raise ResultError(f"PNG must be plain grey with 8 or 16 bits, got colour type {colour}, {bits} bits, {w}x{h}")
    stride = w * bits // 8
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(chunks["IDAT"], h * (stride + 1))
    except zlib.error as error:
        raise ResultError(f"PNG image data are damaged ({error})") from error
    if len(raw) != h * (stride + 1):
        raise ResultError(f"PNG of {w}x{h} holds {len(raw)} bytes of rows, {h * (stride + 1)} are needed")
    rows = _unfilter(np.frombuffer(raw, np.uint8).reshape(h, stride + 1), bits // 8)
    if bits == 8:
        return rows
    return rows.view(">u2").astype(np.uint16)


def _unfilter(filtered: NDArray[np.uint8], pixel: int) -> NDArray[np.uint8]:
    kinds, rows = filtered[:, 0], np.ascontiguousarray(filtered[:, 1:])
    if (kinds == _UP).all():
        return np.cumsum(rows, axis=0, dtype=np.uint8)
    for y, kind in enumerate(kinds):
        if kind == _SUB:
            rows[y] = np.cumsum(rows[y].reshape(-1, pixel), axis=0, dtype=np.uint8).reshape(-1)
        elif kind == _UP:
            if y:
                rows[y] += rows[y - 1]
        elif kind != _NONE:
            raise ResultError(f"PNG row filter {kind} is not read; write the file with filter none, sub or up")
    return rows


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _chunks(data: bytes) -> dict[str, bytes]:
    """Bodies by chunk name; image data joined."""
    found: dict[str, bytes] = {}
    position = 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind, body = data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        end = position + 8 + length
        if end + 4 > len(data) or zlib.crc32(kind + body) != struct.unpack_from(">I", data, end)[0]:
            raise ResultError(f"PNG chunk {kind!r} is cut off or damaged")
        name = kind.decode("latin-1")
        found[name] = found.get(name, b"") + body
        position = end + 4
    return found

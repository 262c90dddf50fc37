"""The messages by which a decoding process hands its frames over.

Each message is one byte of kind, eight bytes of length and the payload. The reader knows the length that each kind may
have before it reads it: text has a bound and a frame has exactly the size that was agreed on, so a decoder taken
over by a hostile file cannot make the reader allocate.
"""

from __future__ import annotations

import json
import os
import select
import struct
import time
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import ClipError

SURVEY, HEADER, FRAME, END, ERROR = b"SHFEX"
_PREFIX = struct.Struct("<BQ")
_FRAME = struct.Struct("<Qd")
MAX_TEXT_BYTES = 1 << 16


def send_json(pipe: BinaryIO, kind: int, content: dict[str, Any]) -> None:
    """Send a small message."""
    payload = json.dumps(content).encode()[:MAX_TEXT_BYTES]
    pipe.write(_PREFIX.pack(kind, len(payload)) + payload)
    pipe.flush()


def send_frame(pipe: BinaryIO, index: int, timestamp_s: float, image: NDArray[np.uint8]) -> None:
    """Send one frame, or the survey's image, of the agreed size."""
    pixels = np.ascontiguousarray(image)
    kind = FRAME if pixels.ndim == 3 else SURVEY
    pipe.write(_PREFIX.pack(kind, _FRAME.size + pixels.nbytes) + _FRAME.pack(index, timestamp_s))
    pipe.write(pixels.reshape(-1).data)
    pipe.flush()


class PipeReader:
    """Reads messages from a decoder that may stop, stall or lie.

    Args:
        descriptor: Where to read.
        wait_s: Longest wait for one message.
    """

    def __init__(self, descriptor: int, wait_s: float) -> None:
        self._descriptor = descriptor
        self._wait_s = wait_s

    def kind(self) -> tuple[int, int] | None:
        """Kind and length of the next message, or ``None`` when the decoder has gone.

        Raises:
            ClipError: If nothing comes for too long.
        """
        prefix = bytearray(_PREFIX.size)
        if self._fill(memoryview(prefix)) < len(prefix):
            return None
        kind, length = _PREFIX.unpack(prefix)
        return kind, length

    def json(self, length: int) -> dict[str, Any]:
        """A small message.

        Raises:
            ClipError: If it is not small, cut off or not an object.
        """
        if length > MAX_TEXT_BYTES:
            raise ClipError(f"the decoder sent a message of {length} bytes; at most {MAX_TEXT_BYTES} are read")
        payload = bytearray(length)
        if self._fill(memoryview(payload)) < length:
            raise ClipError("the decoder stopped in the middle of a message")
        content = json.loads(payload)
        if not isinstance(content, dict):
            raise ClipError("the decoder sent a message that is not an object")
        return content

    def frame(self, length: int, shape: tuple[int, ...]) -> tuple[int, float, NDArray[np.uint8]] | None:
        """Index, time stamp and pixels of a frame of the agreed shape; ``None`` if it was cut off.

        Raises:
            ClipError: If its length is another.
        """
        image = np.empty(shape, np.uint8)
        if length != _FRAME.size + image.nbytes:
            raise ClipError(f"the decoder sent {length} bytes for a frame of shape {shape}")
        head = bytearray(_FRAME.size)
        if self._fill(memoryview(head)) < len(head) or self._fill(image.reshape(-1).data) < image.nbytes:
            return None
        index, timestamp_s = _FRAME.unpack(head)
        return index, timestamp_s, image

    def _fill(self, target: memoryview) -> int:
        """Read until ``target`` is full or the other side has closed; returns the bytes read."""
        deadline = time.monotonic() + self._wait_s
        done = 0
        while done < len(target):
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([self._descriptor], [], [], left)[0]:
                raise ClipError(f"decoding stalled: nothing came for {self._wait_s:g} s")
            got = os.readv(self._descriptor, [target[done:]])
            if got == 0:
                break
            done += got
        return done

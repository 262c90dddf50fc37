"""Seekable read access to an open file that shares its position with nobody."""

from __future__ import annotations

import io
import os
from typing import Any


class RegularFile(io.RawIOBase):
    """A file descriptor read with ``pread``: parent and child can each hold their own position.

    Args:
        descriptor: An open descriptor of a regular file; stays open when this object is closed.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._position = 0
        self.length = os.fstat(descriptor).st_size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self.length}[whence]
        if start + offset < 0:
            raise OSError(f"seek to {start + offset}, before the start of the file")
        self._position = start + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        block = os.pread(self._descriptor, len(view), self._position)
        view[: len(block)] = block
        self._position += len(block)
        return len(block)

"""What reading an untrusted zip archive can raise."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib

ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    OverflowError,
    RuntimeError,
)
"""Everything that :mod:`zipfile` and its decompressors raise on damaged or encrypted archives, or on those of kinds
that they do not know (``NotImplementedError`` is a ``RuntimeError``), found by changing bytes of archives."""

"""Numbered files in a ``tar.gz``, read in one pass: SCARED packs a gigabyte of points into each."""

from __future__ import annotations

import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bathyscope.camera import Size
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthCode, decode_image
from bathyscope_train.data.datasets.frame_files import number_in
from bathyscope_train.evaluation.sequences import F32

_MEMBER_BYTES = 256 << 20
_REWINDS = 3


def numbered_members(archive: Path, ending: str) -> Iterator[tuple[int, bytes]]:
    """Number and content of each member with this ending, in the order of the archive; one in memory at a time.

    Nothing is written to disk, so a name that leaves the archive leads nowhere.

    Raises:
        DatasetError: If the archive is missing or damaged, or a member is larger than any file of the data set.
    """
    try:
        with tarfile.open(archive, "r|*") as tar:
            for member in tar:
                name = Path(member.name)
                if not member.isfile() or name.suffix.lower() != ending or name.name.startswith("."):
                    continue
                if member.size > _MEMBER_BYTES:
                    raise DatasetError(f"{archive}: {member.name} has {member.size} bytes; at most {_MEMBER_BYTES}")
                file = tar.extractfile(member)
                assert file is not None
                yield number_in(name), file.read()
    except FileNotFoundError as error:
        raise DatasetError(f"{archive}: missing") from error
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise DatasetError(f"{archive}: the archive is damaged ({error}); fetch it again") from error


class TarDepth:
    """Depth straight from an archive, for frames that are asked for in its order.

    An archive can only be read forwards. Going back reads it from its beginning: for another pass over the sequence
    that is fine, for frames in any order it would take days, and is refused after a few times.
    """

    def __init__(self, archive: Path, code: DepthCode, size: Size, ending: str = ".tiff") -> None:
        self._source = archive, code, size, ending
        self._members: Iterator[tuple[int, bytes]] = iter(())
        self._held: tuple[int, bytes] | None = None
        self._asked: int | None = None
        self._rewinds = 0

    def read(self, index: int) -> F32 | None:
        """True depth of a frame; ``None`` where the archive passes over its number."""
        if self._asked is None or index < self._asked:
            self._begin_again(index)
        self._asked = index
        while self._held is not None and self._held[0] < index:
            self._advance()
        return self._decoded(*self._held) if self._held is not None and self._held[0] == index else None

    def _begin_again(self, index: int) -> None:
        archive, _, _, ending = self._source
        self._rewinds += index > 0
        if self._rewinds > _REWINDS:
            raise DatasetError(f"{archive}: frames are asked for in any order, an archive has one; {_ADVICE}")
        self._members, self._held = numbered_members(archive, ending), (-1, b"")
        self._advance()

    def _advance(self) -> None:
        before = self._held
        self._held = next(self._members, None)
        if before is not None and self._held is not None and self._held[0] <= before[0]:
            raise DatasetError(f"{self._source[0]}: its members are not in order; {_ADVICE}")

    def _decoded(self, number: int, data: bytes) -> F32:
        archive, code, size, _ = self._source
        where = f"{archive}, number {number}"
        depth = code.decode(decode_image(data, where), where)
        if depth.shape != size:
            (h, w), (height, width) = depth.shape, size
            raise DatasetError(f"{where}: depth of {w}x{h} pixels for frames of {width}x{height}")
        return depth

    def __reduce__(self) -> tuple[type[TarDepth], tuple[Any, ...]]:
        return TarDepth, self._source


_ADVICE = "unpack it, or run `bathyscope data prepare scared`"

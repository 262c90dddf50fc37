"""What the user names on the command line: data sets and systems, taken apart before anything is opened."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast, get_args

from bathyscope.errors import SettingsError
from bathyscope_train.data.datasets.catalogue import KINDS, open_data_set
from bathyscope_train.data.datasets.scared import FrameChoice
from bathyscope_train.evaluation.folder_sequences import open_folders
from bathyscope_train.evaluation.protocols import Protocol
from bathyscope_train.evaluation.sequences import EvaluationSet
from bathyscope_train.systems.registry import SystemName

Named = TypeVar("Named", "DataName", "SystemText")
_DATA = re.compile(r"([A-Za-z0-9_.-]+)((?::[A-Za-z0-9_-]+)*)=(.+)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class DataName:
    """``KIND[:SPLIT][:FRAMES]=ROOT``, or just ``ROOT``."""

    label: str
    """What tables call it: all that stands before ``=``, or the folder's name."""
    kind: str
    root: Path
    split: str | None
    frames: FrameChoice

    @classmethod
    def parse(cls, text: str) -> DataName:
        """Take the text apart.

        Raises:
            SettingsError: If a word after a colon is neither a split of the data set nor a choice of frames.
        """
        match = _DATA.fullmatch(text)
        if match is None:
            root = Path(text)
            return cls(root.resolve().name, root.resolve().name, root, None, "all")
        kind, words, root = match.group(1), match.group(2).split(":")[1:], Path(match.group(3))
        split: str | None = None
        frames: FrameChoice = "all"
        splits = KINDS[kind].splits if kind in KINDS else ()
        for word in words:
            if word in splits:
                split = word
            elif word in get_args(FrameChoice):
                frames = cast(FrameChoice, word)
            else:
                known = ", ".join((*splits, *get_args(FrameChoice)))
                raise SettingsError(f"--data {text}: {word!r} is no split of {kind} and no choice of frames ({known})")
        return cls(f"{kind}{match.group(2)}", kind, root, split, frames)

    def open(self, protocol: Protocol, corrected: Path | None) -> EvaluationSet:
        """The data set, in the split that the protocol means unless one was named.

        A root that is itself a folder of Bathyscope's own layout is opened as that, whatever it is called.

        Raises:
            DatasetError: If it is not there.
        """
        if (self.root / "frames").is_dir() and (self.root / "intrinsics.json").is_file():
            return open_folders(self.kind, self.root)
        scared = self.kind == "scared"
        split = self.split or (protocol.scared_split if scared else None)
        return open_data_set(
            self.kind, self.root, split=split, frames=self.frames, corrected=corrected if scared else None
        )


@dataclass(frozen=True, slots=True)
class SystemText:
    """A system as the user wrote it, and what tables call it."""

    label: str
    text: str
    path: Path | None
    """The bundle or checkpoint, where it is one."""

    @classmethod
    def parse(cls, text: str) -> SystemText:
        """The label is what stands before ``=``, or the file's stem or name, with the kind of depth after ``@``."""
        name = SystemName.parse(text)
        path = Path(name.what)
        label = name.label or (path.stem if path.exists() else name.what)
        depth = "" if name.depth is None or name.label is not None else f"@{name.depth}"
        return cls(label + depth, text, path if path.exists() else None)

    def fingerprint(self) -> str:
        """Changes when the named file does, and is quick: sizes and times of change, not contents."""
        if self.path is None:
            return "named"
        files = [self.path] if self.path.is_file() else sorted(p for p in self.path.rglob("*") if p.is_file())
        return ";".join(f"{file.name}:{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files)


def parse_systems(texts: Sequence[str]) -> list[SystemText]:
    """All systems, each with a label of its own.

    Raises:
        SettingsError: If two have the same label, or none is named.
    """
    return _unlike([SystemText.parse(text) for text in texts], "--systems")


def parse_data(texts: Sequence[str]) -> list[DataName]:
    """All data sets, each with a label of its own.

    Raises:
        SettingsError: If two have the same label, or none is named.
    """
    return _unlike([DataName.parse(text) for text in texts], "--data")


def _unlike(names: list[Named], option: str) -> list[Named]:
    if not names:
        raise SettingsError(f"{option} names nothing; see bathyscope evaluate --help")
    labels = [name.label for name in names]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise SettingsError(f"{option}: {twice[0]} is named twice; write NAME=... to give each its own name")
    return names

"""Where a training run takes its videos from: a data set, a folder in our own layout, or any videos and frames."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, NonNegativeInt, PositiveFloat

from bathyscope.errors import DatasetError
from bathyscope_train.data.clip_windows import ClipWindows, WindowSettings
from bathyscope_train.data.datasets.catalogue import KINDS, DataSetKind, recognise
from bathyscope_train.data.datasets.frame_videos import is_video
from bathyscope_train.data.datasets.own_folder import open_own_folder, own_folders
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.datasets.videos import open_videos

TRAINING_SPLITS = {"scared": "video-train", "simcol": "train"}
"""What is trained on where no split is named: never what the field tests on."""


class ClipSource(BaseModel, frozen=True, extra="forbid"):
    """One folder of videos, and what of it is used."""

    folder: Path = Field(description="A data set, a folder in our own layout or of them, videos, or frames.")
    split: str | None = Field(default=None, description="Part of a data set; its training part unless given.")
    first: NonNegativeInt = Field(default=0, description="First frame used of each video.")
    last: NonNegativeInt | None = Field(default=None, description="First frame that is not used; all unless given.")
    share: PositiveFloat = Field(default=1.0, description="How often it is drawn, relative to its length.")
    upper_half: bool = Field(default=False, description="Pictures stack two eyes: take the upper one.")


@dataclass(frozen=True)
class OpenedSources:
    """Videos of several sources."""

    sequences: tuple[DataSequence, ...]
    shares: tuple[float, ...]
    notes: tuple[str, ...]
    """What is missing or was left out."""


def open_windows(
    sources: Sequence[ClipSource],
    settings: WindowSettings | None = None,
    *,
    seed: int = 0,
    cache: Path | None = None,
    workers: int = 2,
) -> ClipWindows:
    """Everything from folders to windows; see :meth:`ClipWindows.survey`.

    Raises:
        DatasetError: If a folder holds nothing that can be used, or no video holds a window.
    """
    opened = open_sources(sources)
    windows = ClipWindows.survey(
        opened.sequences, settings, seed=seed, shares=opened.shares, cache=cache, workers=workers
    )
    return replace(windows, notes=opened.notes + windows.notes)


def open_sources(sources: Sequence[ClipSource]) -> OpenedSources:
    """The videos of all sources, true depth left aside.

    Raises:
        DatasetError: If there is no source, or one holds nothing that can be used.
    """
    if not sources:
        raise DatasetError("no data to train on; name a folder: data=FOLDER")
    sequences: list[DataSequence] = []
    shares: list[float] = []
    notes: list[str] = []
    for source in sources:
        found, said = _open(source)
        chosen = [_range(sequence, source) for sequence in found]
        sequences += [sequence for sequence in chosen if sequence is not None]
        shares += [source.share for sequence in chosen if sequence is not None]
        notes += said
        short = [sequence.name for sequence, kept in zip(found, chosen, strict=True) if kept is None]
        notes += [f"{name}: it has no frame from {source.first} on; left out" for name in short]
    if not sequences:
        raise DatasetError(f"nothing to train on: {'; '.join(notes[:8])}")
    return OpenedSources(tuple(sequences), tuple(shares), tuple(notes))


def _open(source: ClipSource) -> tuple[list[DataSequence], list[str]]:
    root = source.folder
    if root.is_file():
        return _any_videos(source)
    kind = recognise(root)
    if kind is None:
        return _any_videos(source)
    if kind.name == "folders":
        return _own_folders(source)
    return _data_set(kind, source)


def _any_videos(source: ClipSource) -> tuple[list[DataSequence], list[str]]:
    found = open_videos(source.folder, upper_half=source.upper_half)
    return list(found.sequences), [gap.reason for gap in found.gaps]


def _own_folders(source: ClipSource) -> tuple[list[DataSequence], list[str]]:
    """Folders in our own layout, and whatever else lies beside them."""
    root = source.folder
    paths = own_folders(root)
    sequences: list[DataSequence] = []
    notes: list[str] = []
    for path in paths:
        try:
            sequences.append(open_own_folder(path))
        except DatasetError as error:
            notes.append(str(error))
    for path in sorted(root.iterdir() if root not in paths else ()):
        if path not in paths and (is_video(path) or (path.is_dir() and not path.name.startswith("."))):
            try:
                found, said = _any_videos(source.model_copy(update={"folder": path}))
            except DatasetError as error:
                notes.append(str(error))
            else:
                sequences += found
                notes += said
    if not sequences:
        raise DatasetError(f"{root}: nothing to train on: {'; '.join(notes)}")
    return sequences, notes


def _data_set(kind: DataSetKind, source: ClipSource) -> tuple[list[DataSequence], list[str]]:
    split = source.split or TRAINING_SPLITS.get(kind.name) or (kind.splits[0] if kind.splits else "")
    if kind.splits and split not in kind.splits:
        raise DatasetError(f"{kind.name} has no split {split!r}; known are {', '.join(kind.splits)}")
    opened = KINDS[kind.name].open(source.folder, split, "all", None)
    notes = [f"{gap.sequence}: {gap.what}{': ' if gap.what else ''}{gap.reason}" for gap in opened.gaps]
    sequences = [sequence for sequence in opened.sequences if isinstance(sequence, DataSequence)]
    assert len(sequences) == len(opened.sequences)
    return [replace(sequence, depth=None) for sequence in sequences], notes


def _range(sequence: DataSequence, source: ClipSource) -> DataSequence | None:
    """The frames that a source wants; ``None`` if there are none."""
    last = len(sequence) if source.last is None else min(source.last, len(sequence))
    if source.first >= last:
        return None
    if (source.first, last) == (0, len(sequence)):
        return sequence
    return sequence.select(range(source.first, last))


def sources_hash(windows: ClipWindows) -> str:
    """Twelve hexadecimal digits that change with the videos, the frames kept of them, and the settings."""
    digest = hashlib.sha256(windows.settings.model_dump_json().encode())
    for sequence, survey in windows.clips:
        digest.update(f"{sequence.name} {survey.size} ".encode())
        digest.update(np.ascontiguousarray(survey.kept, np.int64).tobytes())
    return digest.hexdigest()[:12]

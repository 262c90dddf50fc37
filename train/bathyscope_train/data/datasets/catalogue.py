"""The data sets that can be opened by name, and which of them a folder holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.c3vd import is_c3vd, open_c3vd
from bathyscope_train.data.datasets.endoslam import is_endoslam, open_endoslam
from bathyscope_train.data.datasets.hamlyn import hamlyn_splits, is_hamlyn, open_hamlyn
from bathyscope_train.data.datasets.own_folder import own_folders
from bathyscope_train.data.datasets.scared import FrameChoice, open_scared
from bathyscope_train.data.datasets.scared_splits import scared_splits
from bathyscope_train.data.datasets.scared_tree import is_scared
from bathyscope_train.data.datasets.simcol import is_simcol, open_simcol
from bathyscope_train.evaluation.folder_sequences import open_folders
from bathyscope_train.evaluation.sequences import EvaluationSet


@dataclass(frozen=True)
class DataSetKind:
    """One data set."""

    name: str
    splits: tuple[str, ...]
    """Names of its parts, the default first; empty where it has none."""
    recognises: Callable[[Path], bool]
    """Whether a folder looks like it."""
    open: Callable[[Path, str, FrameChoice, Path | None], EvaluationSet]


_VIDEO_TEST = "video-test"
KINDS: Mapping[str, DataSetKind] = {
    kind.name: kind
    for kind in (
        DataSetKind(
            "scared",
            (_VIDEO_TEST, *(name for name in scared_splits() if name != _VIDEO_TEST)),
            is_scared,
            lambda root, split, frames, corrected: open_scared(root, split, frames=frames, corrected=corrected),
        ),
        DataSetKind("hamlyn", tuple(hamlyn_splits()), is_hamlyn, lambda root, split, *_: open_hamlyn(root, split)),
        DataSetKind("c3vd", (), is_c3vd, lambda root, *_: open_c3vd(root)),
        DataSetKind("simcol", ("test", "train", "all"), is_simcol, lambda root, split, *_: open_simcol(root, split)),
        DataSetKind("endoslam", (), is_endoslam, lambda root, *_: open_endoslam(root)),
        DataSetKind(
            "folders",
            (),
            lambda root: bool(own_folders(root)),
            lambda root, *_: open_folders(root.resolve().name, root),
        ),
    )
}
"""In the order in which a folder is tried."""


def recognise(root: Path) -> DataSetKind | None:
    """The data set that a folder looks like; ``None`` for none of them, as for a folder of videos.

    Raises:
        DatasetError: If there is no such folder.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder")
    return next((kind for kind in KINDS.values() if kind.recognises(root)), None)


def open_data_set(
    kind: str,
    root: Path,
    *,
    split: str | None = None,
    frames: FrameChoice = "all",
    corrected: Path | None = None,
) -> EvaluationSet:
    """A data set for evaluation.

    Args:
        kind: One of :data:`KINDS`; any other name stands for a folder, or folders, in Bathyscope's own layout.
        root: Where it is.
        split: Part of it; the default of the data set unless given.
        frames: SCARED alone: all frames, the measured keyframes, or those of ``corrected``.
        corrected: SCARED alone: folder with poses and depth of SCARED-C.

    Raises:
        DatasetError: If it is not there, or there is no such part.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder; --data names a folder for {kind}")
    found = KINDS.get(kind)
    if found is None:
        return open_folders(kind, root)
    if split is not None and split not in found.splits:
        raise DatasetError(f"{kind} has no split {split!r}; known are {', '.join(found.splits) or 'none'}")
    if kind != "scared" and (frames != "all" or corrected is not None):
        raise DatasetError(f"{kind} has no keyframes and no corrected frames; only scared does")
    return found.open(root, split or (found.splits[0] if found.splits else ""), frames, corrected)

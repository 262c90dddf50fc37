"""SCARED's sequences, their published lengths, and the choices of them that papers report on.

Two families of splits are in use, and one trains on what the other tests on: the ``endovis`` lists of AF-SfMLearner and
EndoDAC train on datasets 8 and 9, which are the test set of the video split.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from bathyscope.errors import DatasetError

WRONG_CALIBRATION = frozenset((4, 5))
"""Data sets whose intrinsics the organisers call wrong: depth and image do not lie on each other."""
RENUMBERED = frozenset((8, 9))
"""Test sets: keyframes count from 0 in the archives, and from 1 in trees made for the endovis lists."""


@dataclass(frozen=True)
class ScaredSplit:
    """Some sequences of SCARED."""

    name: str
    words: str
    """What it is, for people."""
    frames: Mapping[str, tuple[int, ...] | None]
    """By sequence, ``dataset8/keyframe0``: the numbers of the frames from 0, or ``None`` for all of them."""


@cache
def frame_counts() -> Mapping[str, int]:
    """Published number of frames of each of the 35 sequences."""
    return {name: int(count) for name, count in _lists()["frame_counts"].items()}


@cache
def scared_splits() -> Mapping[str, ScaredSplit]:
    """The known splits by name."""
    lists = _lists()
    video: dict[str, dict[str, None]] = {part: dict.fromkeys(names) for part, names in lists["video"].items()}
    everything = dict.fromkeys(frame_counts())
    endovis = {name: tuple(line - 1 for line in lines) for name, lines in lists["endovis_test"].items()}
    good: dict[str, None] = {
        name: None for name in everything if dataset_number(name) not in {*WRONG_CALIBRATION, *RENUMBERED}
    }
    found = [
        ScaredSplit("video-train", "video split of EndoDAV, training part (24 sequences)", video["train"]),
        ScaredSplit("video-val", "video split of EndoDAV, validation part (3 sequences)", video["val"]),
        ScaredSplit("video-test", "video split of EndoDAV, test part (8 sequences)", video["test"]),
        ScaredSplit("endovis-test", "AF-SfMLearner/EndoDAC test list (551 frames of 7 sequences)", endovis),
        ScaredSplit("without-4-5-train", "data sets 1, 2, 3, 6, 7 (19 sequences, good calibration)", good),
        ScaredSplit("all", "all 35 sequences", everything),
    ]
    return {split.name: split for split in found}


def scared_split(name: str) -> ScaredSplit:
    """A split by name.

    Raises:
        DatasetError: If there is none of this name.
    """
    known = scared_splits()
    if name not in known:
        raise DatasetError(f"SCARED has no split {name!r}; known are {', '.join(known)}")
    return known[name]


def dataset_number(sequence: str) -> int:
    """8 for ``dataset8/keyframe0``."""
    return int(sequence.split("/", maxsplit=1)[0].removeprefix("dataset"))


def sequence_order(sequence: str) -> tuple[int, int]:
    """Sort key: numbers of data set and keyframe."""
    return dataset_number(sequence), int(sequence.split("/")[1].removeprefix("keyframe"))


@cache
def _lists() -> dict[str, Any]:
    text = files("bathyscope_train.data.datasets").joinpath("splits/scared.json").read_text(encoding="utf-8")
    lists = json.loads(text)
    assert isinstance(lists, dict)
    return lists

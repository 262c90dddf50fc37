"""What is known to go wrong with each data set, told where it applies to the folder at hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bathyscope_train.data.datasets.c3vd import PUBLISHED_FRAMES, PUBLISHED_VIDEOS
from bathyscope_train.data.datasets.hamlyn import LAST_UNCROPPED
from bathyscope_train.data.datasets.scared_splits import (
    RENUMBERED,
    WRONG_CALIBRATION,
    dataset_number,
    scared_split,
)
from bathyscope_train.data.datasets.scared_tree import find_scared
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.data.datasets.simcol import TEST_TRAJECTORIES, simcol_trajectories
from bathyscope_train.evaluation.images import image_files

Pitfall = tuple[str, str]
"""Sequence (empty for the whole set) and what to know."""
_FIXED_CAMERA = (0.82, 1.02)


def pitfalls(kind: str, root: Path, sequences: Sequence[DataSequence]) -> list[Pitfall]:
    """The pitfalls of a data set that apply to what is in ``root``."""
    known = {"scared": _scared, "hamlyn": _hamlyn, "c3vd": _c3vd, "simcol": _simcol, "endoslam": _endoslam}
    return list(known[kind](root, sequences)) if kind in known else []


def _scared(root: Path, sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    found = find_scared(root)
    yield (
        "",
        "only keyframes were measured; other depth drifts with the frame number: report keyframes beside all",
    )
    wrong = sorted({dataset_number(name) for name in found} & WRONG_CALIBRATION)
    if wrong:
        numbers = " and ".join(map(str, wrong))
        yield (
            "",
            f"calibration of data set {numbers} is wrong (organisers' note); so are 2 of the 3 of video-val",
        )
    if any(folder.renumbered for folder in found.values()):
        yield (
            "",
            "keyframes of data sets 8 and 9 count from 1 in this tree; names here count from 0 as published",
        )
    test, endovis = set(scared_split("video-test").frames), set(scared_split("endovis-test").frames)
    if test & set(found) and endovis & set(found):
        yield (
            "",
            "endovis and video splits swap training and test: weights of one must not be scored on the other",
        )
    without = sorted(s.name for s in sequences if s.depth is None and dataset_number(s.name) in RENUMBERED)
    if without:
        yield "", f"test sequences without true depth (a copy without data/ circulates): {', '.join(without)}"
    if any(folder.points is not None and folder.points[0] == "depthmap" for folder in found.values()):
        yield "", "depth maps of scared_toolkit: 128 steps a millimetre are assumed; some of its functions write 256"
    if any(folder.points is not None and folder.points[0] == "tar" for folder in found.values()):
        yield "", "depth is read from archives, forwards and slowly; `bathyscope data prepare scared` converts it once"
    yield from _other_cameras(sequences)


def _other_cameras(sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    """How far the camera that the field's evaluators use for everything is from each sequence's own."""
    ratios = [
        (s.intrinsics[0, 0] / s.size[1] / _FIXED_CAMERA[0], s.intrinsics[1, 1] / s.size[0] / _FIXED_CAMERA[1])
        for s in sequences
        if s.intrinsics is not None
    ]
    if ratios:
        low, high = np.min(ratios), np.max(ratios)
        yield (
            "",
            f"focal lengths are {low:.2f} to {high:.2f} times those of the fixed matrix of public evaluators",
        )


def _hamlyn(root: Path, sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    yield (
        "",
        "depth is stereo matching, not measured; ranges in use: 1 to 150 mm (evaluators), 1 to 300 mm (authors)",
    )
    cropped = [s.name for s in sequences if int(s.name.removeprefix("rectified")) > LAST_UNCROPPED]
    if cropped:
        yield (
            "",
            f"per-frame evaluators crop {len(cropped)} sequences to columns 180 to 589; video ones do not",
        )
    without = [s.name for s in sequences if s.intrinsics is None]
    if without:
        yield "", f"no intrinsics.txt (calibration/NN/) for {', '.join(without)}"
    for sequence in sequences:
        paths = image_files(root / sequence.name / "depth01")
        if [path.name for path in paths] != sorted(path.name for path in paths):
            yield sequence.name, "names are not padded with zeros: programs that sort depth as text pair it wrongly"
    for path in sorted(root.iterdir()):
        if (path / "color").is_dir() and (path / "depth").is_dir():
            yield path.name, "tracking test data with predicted depth and other intrinsics; not for evaluation"


def _c3vd(root: Path, sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    frames = sum(map(len, sequences))
    yield "", f"{len(sequences)} videos, {frames} frames; the whole set has {PUBLISHED_VIDEOS} and {PUBLISHED_FRAMES}"
    yield "", "a fisheye camera: the pinhole intrinsics are an approximation; depth ends at 100 mm"
    if any((path / "color").is_dir() for path in root.rglob("*/") if (path / "pose.txt").is_file()):
        yield "", "a preprocessed variant with 8-bit depth: steps of 0.4 mm"


def _simcol(root: Path, sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    yield "", "depth and poses are in centimetres; published numbers use one least-squares scale a sequence"
    if set(simcol_trajectories(root)) & set(TEST_TRAJECTORIES):
        yield "", "test trajectories (S5 S10 S15 B5 B10 B15 O1-3) are here; training on `all` would include them"
    if next(root.rglob("cam.txt"), None) is not None:
        yield (
            "",
            "cam.txt is not read: a public script puts its numbers into wrong cells (f is about 227.6, c 237.5)",
        )


def _endoslam(root: Path, sequences: Sequence[DataSequence]) -> Iterator[Pitfall]:
    yield "", "depth pictures have no stated unit and are shifted against the frames; not used as ground truth"

"""Hamlyn videos, rectified by Recasens et al. (Endo-Depth-and-Motion), with depth from Libelas stereo.

::

    ROOT/rectifiedNN/image01/*.jpg    left images; image02/ the right ones
                    /depth01/*.png    uint16, millimetres, 0 = unknown; depth02/ of the right ones
    ROOT/calibration/NN/intrinsics.txt   3x3; also looked for in rectifiedNN/

Depth is a stereo matcher's, not a sensor's: noisy, with holes and outliers on highlights.
"""

from __future__ import annotations

import json
import re
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np

from bathyscope.camera import F64
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthFiles, GreyDepth
from bathyscope_train.data.datasets.frame_files import ImageFiles, by_number, image_size
from bathyscope_train.data.datasets.scared_frame_data import corner_intrinsics
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.images import image_files
from bathyscope_train.evaluation.sequences import Crop, EvaluationSet, Gap

DEPTH_RANGE_MM = (1e-3, 150.0)
"""Of AF-SfMLearner, EndoDAC and EndoDAV; the set's authors used 1 to 300 mm."""
LAST_UNCROPPED = 13
"""EndoDAC cuts columns 180 to 589 out of the sequences after this one, whose borders are black."""
_CROPPED_COLUMNS = (180, 590)
_NAME = re.compile(r"rectified(\d+)")
_NOTE = "depth is from stereo matching (Libelas), not measured: noisy, with holes"


@cache
def hamlyn_splits() -> dict[str, tuple[str, ...]]:
    """Names of sequences: ``all`` 21 of the published evaluations, ``short`` the last five."""
    text = files("bathyscope_train.data.datasets").joinpath("splits/hamlyn.json").read_text(encoding="utf-8")
    lists = json.loads(text)
    return {split: tuple(lists[split]) for split in ("all", "short")}


def is_hamlyn(root: Path) -> bool:
    """Whether a folder looks like the rectified Hamlyn set."""
    return any(_NAME.fullmatch(path.name) and (path / "image01").is_dir() for path in root.iterdir())


def open_hamlyn(root: Path, split: str = "all") -> EvaluationSet:
    """The sequences of a split.

    Raises:
        DatasetError: If there is no such split, or none of its sequences is there.
    """
    splits = hamlyn_splits()
    if split not in splits:
        raise DatasetError(f"Hamlyn has no split {split!r}; known are {', '.join(splits)}")
    sequences: list[DataSequence] = []
    gaps: list[Gap] = []
    for name in splits[split]:
        folder = root / name
        if not (folder / "image01").is_dir():
            gaps.append(Gap(name, "", f"{folder}: no such folder, or no image01/ in it"))
            continue
        sequence, problems = _open(folder)
        sequences.append(sequence)
        gaps += problems
    if not sequences:
        raise DatasetError(f"{root}: none of the {len(gaps)} sequences rectifiedNN/image01 of Hamlyn is there")
    words = f"Hamlyn rectified, {split} ({len(splits[split])} sequences)"
    return EvaluationSet("hamlyn", tuple(sequences), words, tuple(gaps))


def _open(folder: Path) -> tuple[DataSequence, list[Gap]]:
    images, depth = by_number(image_files(folder / "image01")), by_number(image_files(folder / "depth01"))
    if not images:
        raise DatasetError(f"{folder / 'image01'}: no images")
    gaps = [Gap(folder.name, images[n].stem, "no depth file of this number") for n in images if n not in depth]
    gaps += [Gap(folder.name, depth[n].stem, "depth without an image") for n in depth if n not in images]
    without = [name for name in ("image02", "depth02") if not image_files(folder / name)]
    if without:
        reason = f"no {' and no '.join(without)}; evaluators that ask for all four files leave this sequence out"
        gaps.append(Gap(folder.name, "", reason))
    size = image_size(next(iter(images.values())))
    sequence = DataSequence(
        name=folder.name,
        frames=ImageFiles(tuple(images.values())),
        frame_names=[path.stem for path in images.values()],
        size=size,
        depth=DepthFiles({i: depth[n] for i, n in enumerate(images) if n in depth}, GreyDepth(1.0), size),
        depth_unit="mm",
        depth_range=DEPTH_RANGE_MM,
        intrinsics=_intrinsics(folder),
        published_crop=_published_crop(folder.name, size),
        notes=(_NOTE,),
    )
    return sequence, gaps


def _published_crop(name: str, size: tuple[int, int]) -> Crop | None:
    match = _NAME.fullmatch(name)
    left, right = _CROPPED_COLUMNS
    if match is None or int(match[1]) <= LAST_UNCROPPED or size[1] < right:
        return None
    return Crop(0, size[0], left, right)


def _intrinsics(folder: Path) -> F64 | None:
    number = folder.name.removeprefix("rectified")
    places = (
        folder.parent / "calibration" / number / "intrinsics.txt",
        folder.parent / "calibration" / str(int(number)) / "intrinsics.txt",
        folder / "intrinsics.txt",
    )
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        return None
    try:
        matrix = np.loadtxt(path, np.float64, ndmin=2)
    except ValueError as error:
        raise DatasetError(f"{path}: not a table of numbers ({error})") from error
    return corner_intrinsics(matrix[:3, :3], str(path))

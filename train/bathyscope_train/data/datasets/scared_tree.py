"""Find SCARED's sequences in a folder, whichever of the trees in use it holds.

======================  =========================================  ===================================================
tree                    frames                                     true depth
======================  =========================================  ===================================================
official                ``data/rgb.mp4``, both eyes stacked        ``data/scene_points.tar.gz``, or unpacked
EndoDAC, EndoDAV        ``data/left/*NNNN.png``                    ``data/scene_points/*.tiff`` or ``.npy``
scared_toolkit          ``data/left/NNNNNN.png``                   ``data/depthmap/NNNNNN.png``
AF-SfMLearner           ``image_02/data/NNNNNNNNNN.png``, from 1   ``image_02/data/groundtruth/scene_pointsNNNNNN.tiff``
prepared                ``sequences/datasetD_keyframeK/frames/``   ``sequences/datasetD_keyframeK/depth/``
======================  =========================================  ===================================================

`Prepared` is what ``bathyscope data prepare scared`` writes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.frame_files import by_number
from bathyscope_train.data.datasets.frame_videos import VideoFrames
from bathyscope_train.data.datasets.scared_splits import RENUMBERED, frame_counts, sequence_order
from bathyscope_train.evaluation.images import image_files

Layout = Literal["official", "left images", "AF-SfMLearner", "prepared", "still"]
MARK = "prepared.json"
"""File at the root of a prepared tree."""
_IMAGES: Mapping[str, str] = {"AF-SfMLearner": "image_02/data", "left images": "data/left", "prepared": "frames"}
_DATASET = re.compile(r"(?:test_)?dataset_?(\d+)", re.IGNORECASE)
_KEYFRAME = re.compile(r"keyframe_?(\d+)", re.IGNORECASE)


@dataclass(frozen=True)
class ScaredFolder:
    """One keyframe's folder."""

    path: Path
    name: str
    """Numbered as in the archives: ``dataset8/keyframe0``."""
    layout: Layout
    renumbered: bool = False
    """Whether the folder's own number is one larger."""

    @property
    def images(self) -> dict[int, Path]:
        """Image files by number, where frames are files."""
        return by_number(image_files(self.path / _IMAGES[self.layout]))

    @property
    def video(self) -> Path:
        """The stacked video of the official tree."""
        return self.path / "data" / "rgb.mp4"

    @property
    def points(self) -> tuple[str, Path] | None:
        """Kind and place of true depth; kinds are ``points``, ``tar``, ``left npy``, ``depthmap``, ``prepared``."""
        places = (
            ("prepared", self.path / "depth"),
            ("points", self.path / "image_02/data/groundtruth"),
            ("points", self.path / "data/scene_points"),
            ("left npy", self.path / "data/scene_points_left"),
            ("depthmap", self.path / "data/depthmap"),
            ("tar", self.path / "data/scene_points.tar.gz"),
        )
        return next((place for place in places if _holds_something(place[1])), None)

    @property
    def frame_data(self) -> Path | None:
        """Where the jsons are: a folder or an archive; the table of a prepared tree."""
        places = (
            self.path / "poses.txt",
            self.path / "data/frame_data",
            self.path / "data/frame_data.tar.gz",
        )
        return next((place for place in places if _holds_something(place)), None)


def find_scared(root: Path) -> dict[str, ScaredFolder]:
    """Every keyframe folder below ``root``, by the name of its sequence, in order.

    Raises:
        DatasetError: If there is none, or one sequence is there twice.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder")
    if (root / MARK).is_file():
        return _prepared(root)
    found: dict[str, ScaredFolder] = {}
    for dataset, number in _dataset_folders(root):
        for folder in _keyframes(dataset, number):
            if folder.name in found:
                raise DatasetError(f"{folder.name} is in both {found[folder.name].path} and {folder.path}; remove one")
            found[folder.name] = folder
    if not found:
        raise DatasetError(
            f"{root}: no SCARED here; expected dataset_1/keyframe_1/data/rgb.mp4 and so on, or "
            "train/dataset1/keyframe1/data/left/"
        )
    return dict(sorted(found.items(), key=lambda item: sequence_order(item[0])))


def is_scared(root: Path) -> bool:
    """Whether a folder looks like SCARED."""
    if (root / MARK).is_file():
        return True
    keyframes = (path for dataset, _ in _dataset_folders(root) for path, _ in _matching(dataset, _KEYFRAME))
    return any(_layout(path) is not None for path in keyframes)


def _prepared(root: Path) -> dict[str, ScaredFolder]:
    """Sequences of a tree that ``prepare`` wrote; those still being written have no ``intrinsics.json``."""
    pattern = re.compile(r"(dataset\d+)_(keyframe\d+)")
    names = [(path, pattern.fullmatch(path.name)) for path in (root / "sequences").glob("*/")]
    done = {f"{match[1]}/{match[2]}": path for path, match in names if match and (path / "intrinsics.json").is_file()}
    if not done:
        raise DatasetError(f"{root}: no finished sequence in sequences/; run `bathyscope data prepare scared` again")
    return {name: ScaredFolder(done[name], name, "prepared") for name in sorted(done, key=sequence_order)}


def _dataset_folders(root: Path) -> Iterator[tuple[Path, int]]:
    """Folders of data sets in ``root``, in it (``train/``, ``test/``), or ``root`` itself."""
    own = _DATASET.fullmatch(root.resolve().name)
    if own:
        yield root, int(own[1])
        return
    yield from _matching(root, _DATASET)
    for part in sorted(path for path in root.iterdir() if path.is_dir() and not _DATASET.fullmatch(path.name)):
        yield from _matching(part, _DATASET)


def _keyframes(dataset: Path, number: int) -> list[ScaredFolder]:
    found = {keyframe: (path, layout) for path, keyframe in _matching(dataset, _KEYFRAME) if (layout := _layout(path))}
    shift = int(number in RENUMBERED and 0 not in found and _counts_from_one(number, found))
    return [
        ScaredFolder(path, f"dataset{number}/keyframe{keyframe - shift}", layout, renumbered=shift == 1)
        for keyframe, (path, layout) in sorted(found.items())
    ]


def _counts_from_one(number: int, found: Mapping[int, tuple[Path, Layout]]) -> bool:
    """Whether keyframes of a test set are numbered from 1: told by their lengths, or else by the tree."""
    lengths = {k: _length(path, layout) for k, (path, layout) in found.items() if layout != "still"}
    published = frame_counts()

    def agreeing(shift: int) -> int:
        return sum(published.get(f"dataset{number}/keyframe{k - shift}") == n for k, n in lengths.items())

    if agreeing(0) != agreeing(1):
        return agreeing(1) > agreeing(0)
    return any(layout == "AF-SfMLearner" for _, layout in found.values())


def _length(path: Path, layout: Layout) -> int:
    folder = ScaredFolder(path, "", layout)
    if layout == "official":
        try:
            return len(VideoFrames(folder.video))
        except DatasetError:
            return 0
    return len(folder.images)


def _layout(keyframe: Path) -> Layout | None:
    if image_files(keyframe / "data" / "left"):
        return "left images"
    if image_files(keyframe / "image_02" / "data"):
        return "AF-SfMLearner"
    if (keyframe / "data" / "rgb.mp4").is_file():
        return "official"
    return "still" if (keyframe / "Left_Image.png").is_file() else None


def _matching(folder: Path, pattern: re.Pattern[str]) -> list[tuple[Path, int]]:
    """Folders in ``folder`` whose whole name matches, with their number."""
    found = [(path, pattern.fullmatch(path.name)) for path in folder.iterdir() if path.is_dir()]
    return sorted(((path, int(match[1])) for path, match in found if match), key=lambda item: item[1])


def _holds_something(place: Path) -> bool:
    return place.is_file() or (place.is_dir() and next(place.iterdir(), None) is not None)

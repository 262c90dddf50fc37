"""C3VD: a clinical colonoscope in silicone colon models, with depth from the registered mesh, up to 100 mm.

::

    ROOT/VIDEO/NNNN_color.png   1350x1080; pose.txt: 16 numbers a line with commas, camera to world, column by column
              /NNNN_depth.tiff  uint16, depth_mm = value * 100 / 65535
    ROOT/VIDEO/color/*.png      or a preprocessed variant, 675x540
              /depth/*.png      8 bits, depth_mm = value / 2.55

The camera is a fisheye; the intrinsics here are the usual pinhole approximation, wrong towards the rim.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from bathyscope.camera import F64, Size, scale_intrinsics
from bathyscope.errors import DatasetError
from bathyscope_train.data.datasets.depth_files import DepthFiles, GreyDepth
from bathyscope_train.data.datasets.frame_files import ImageFiles, by_number, image_size
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.evaluation.folders import parse_pose
from bathyscope_train.evaluation.images import image_files
from bathyscope_train.evaluation.sequences import Crop, EvaluationSet, Gap

DEPTH_RANGE_MM = (1e-3, 100.0)
PUBLISHED_VIDEOS, PUBLISHED_FRAMES = 22, 10_015
"""As the set's paper counts them."""
_FULL_SIZE: Size = (1080, 1350)
_PINHOLE = np.array([[802.319, 0.0, 668.286], [0.0, 801.885, 547.733], [0.0, 0.0, 1.0]])
_HALF_SIZE: Size = (540, 675)
_HALF_PINHOLE = np.array([[401.16, 0.0, 334.14], [0.0, 400.94, 273.87], [0.0, 0.0, 1.0]])
_CROP = Crop(180, 900, 200, 1150)
"""What EndoDAC cuts out of the full size."""
_NOTE = "a fisheye camera; intrinsics are a pinhole approximation"


def c3vd_videos(root: Path) -> list[Path]:
    """Folders of videos in ``root`` or one level below, or ``root`` itself."""
    return sorted({place for place in (root, *root.glob("*/"), *root.glob("*/*/")) if _is_video(place)})


def is_c3vd(root: Path) -> bool:
    """Whether a folder looks like C3VD."""
    return bool(c3vd_videos(root))


def open_c3vd(root: Path) -> EvaluationSet:
    """All videos of a folder.

    Raises:
        DatasetError: If there is none.
    """
    videos = c3vd_videos(root)
    if not videos:
        raise DatasetError(f"{root}: no C3VD here; expected VIDEO/0000_color.png with 0000_depth.tiff")
    opened = [_open(path) for path in videos]
    gaps = tuple(gap for _, problems in opened for gap in problems)
    return EvaluationSet("c3vd", tuple(sequence for sequence, _ in opened), f"{len(opened)} videos of C3VD", gaps)


def _is_video(folder: Path) -> bool:
    official = (
        next(folder.glob("*_color.png"), None) is not None and next(folder.glob("*_depth.tif*"), None) is not None
    )
    return official or ((folder / "color").is_dir() and (folder / "depth").is_dir() and (folder / "pose.txt").is_file())


def _open(folder: Path) -> tuple[DataSequence, list[Gap]]:
    official = not (folder / "color").is_dir()
    if official:
        images, depth = _official_files(folder.glob("*_color.png")), _official_files(folder.glob("*_depth.tif*"))
        code = GreyDepth(100 / 65535, ceiling=65535)
    else:
        images, depth = by_number(image_files(folder / "color")), by_number(image_files(folder / "depth"))
        code = GreyDepth(1 / 2.55, ceiling=255)
    if not images:
        raise DatasetError(f"{folder}: no colour frames")
    size = image_size(next(iter(images.values())))
    gaps = [Gap(folder.name, f"{n:04d}", "no depth file of this number") for n in images if n not in depth]
    gaps += [Gap(folder.name, f"{n:04d}", "depth without a colour frame") for n in depth if n not in images]
    poses, problem = _poses(folder / "pose.txt", list(images))
    gaps += [Gap(folder.name, "pose.txt", problem)] if problem else []
    sequence = DataSequence(
        name=folder.name,
        frames=ImageFiles(tuple(images.values())),
        frame_names=[f"{n:04d}" for n in images],
        size=size,
        depth=DepthFiles({i: depth[n] for i, n in enumerate(images) if n in depth}, code, size),
        depth_unit="mm",
        depth_range=DEPTH_RANGE_MM,
        intrinsics=_intrinsics(size),
        world_from_camera=poses,
        pose_unit=None if poses is None else "mm",
        published_crop=_CROP if size == _FULL_SIZE else None,
        notes=(_NOTE,),
    )
    return sequence, gaps


def _official_files(paths: Iterable[Path]) -> dict[int, Path]:
    """By the number before ``_color`` or ``_depth``."""
    numbered = [path for path in paths if path.name.split("_")[0].isdigit()]
    return {int(path.name.split("_")[0]): path for path in sorted(numbered)}


def _intrinsics(size: Size) -> F64:
    """The approximation for images of any size: that of the preprocessed variant for its own."""
    if size == _HALF_SIZE:
        return _HALF_PINHOLE.copy()
    return scale_intrinsics(_PINHOLE, _FULL_SIZE, size)


def _poses(path: Path, numbers: list[int]) -> tuple[F64 | None, str | None]:
    """``world_from_camera`` (t, 4, 4) of the frames of these numbers; and what does not fit."""
    if not path.is_file():
        return None, f"{path}: missing; no poses"
    lines = [line.replace(",", " ").split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    # a line holds the transposed matrix: translation last; read row by row it would be in the bottom row
    table = [parse_pose(_transposed(words), f"{path}, line {line}") for line, words in enumerate(lines, 1)]
    poses = np.stack([table[n] if n < len(table) else np.full((4, 4), np.nan) for n in numbers])
    short = len(table) <= max(numbers)
    return poses, f"{path}: {len(table)} poses, frames are numbered up to {max(numbers)}" if short else None


def _transposed(words: list[str]) -> list[str]:
    return [words[4 * column + row] for row in range(4) for column in range(4)] if len(words) == 16 else words

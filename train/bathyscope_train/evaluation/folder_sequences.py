"""Data set folders of Bathyscope's own layout as sequences of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.folders import DatasetFolder
from bathyscope_train.evaluation.sequences import F32, Crop, EvaluationSet, Gap, Unit

_OWN_WORDS = {"millimetre": "mm", "millimeter": "mm", "centimetre": "cm", "metre": "m", "meter": "m"}


@dataclass(frozen=True)
class FolderSequence:
    """One folder; implements :class:`~bathyscope_train.evaluation.sequences.EvaluationSequence`."""

    folder: DatasetFolder
    name: str

    @property
    def frame_names(self) -> Sequence[str]:
        """File names without their endings."""
        return [path.stem for path in self.folder.frames]

    @property
    def size(self) -> Size:
        """(height, width)."""
        return self.folder.calibration.size

    @property
    def depth_unit(self) -> Unit:
        """``depth_unit`` of ``intrinsics.json``."""
        return known_unit(self.folder.calibration.depth_unit)

    @property
    def pose_unit(self) -> Unit | None:
        """``pose_unit`` of ``intrinsics.json``."""
        return None if self.world_from_camera is None else known_unit(self.folder.calibration.pose_unit)

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """``depth_valid`` of ``intrinsics.json``, or else whatever its 16-bit depth maps can hold."""
        calibration = self.folder.calibration
        if calibration.depth_valid is not None or calibration.depth_scale is None:
            return calibration.depth_valid
        return 0.0, 65536 * calibration.depth_scale

    @property
    def intrinsics(self) -> F64 | None:
        """(3, 3)."""
        c = self.folder.calibration
        return np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])

    @property
    def world_from_camera(self) -> F64 | None:
        """(t, 4, 4), NaN without a pose."""
        return self.folder.world_from_camera if self.folder.has_pose.any() else None

    @property
    def published_crop(self) -> Crop | None:
        """Folders hold what they want evaluated."""
        return None

    @property
    def groups(self) -> Mapping[str, NDArray[np.bool_]]:
        """None."""
        return {}

    @property
    def notes(self) -> tuple[str, ...]:
        """That truth is sparse, where it is."""
        return ("sparse truth: points of a reconstruction",) if self.folder.truth.kind == "sparse" else ()

    def image(self, index: int) -> NDArray[np.uint8]:
        """RGB (h, w, 3)."""
        return self.folder.image(index)

    def truth(self, index: int) -> F32 | None:
        """(h, w), 0 where unknown; of several points in one pixel the nearest, which hides the others."""
        known = self.folder.truth.at(index)
        if len(known.depth) == 0:
            return None
        nearest = np.full(self.size, np.inf, np.float32)
        np.minimum.at(nearest, (known.rows, known.columns), known.depth.astype(np.float32))
        return np.where(np.isfinite(nearest), nearest, np.float32(0))


def known_unit(text: str | None) -> Unit:
    """The unit that a calibration names; anything but millimetres, centimetres and metres is arbitrary."""
    word = (text or "arbitrary").strip().lower()
    word = _OWN_WORDS.get(word.removesuffix("s"), word)
    return cast(Unit, word) if word in get_args(Unit) else "arbitrary"


def open_folders(name: str, root: Path) -> EvaluationSet:
    """A data set folder, or a folder of them; see :class:`DatasetFolder` for the layout.

    Folders inside ``root`` that hold ``frames/`` or ``intrinsics.json`` and are still not in the layout are named as
    gaps; others are not looked at.

    Raises:
        DatasetError: If there is no data set folder at all; says why.
    """
    if (root / "frames").is_dir():
        return EvaluationSet(name, (FolderSequence(DatasetFolder.open(root), root.resolve().name),), "the folder")
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder")
    sequences, gaps = [], []
    for path in sorted(path for path in root.iterdir() if _looks_like_data(path)):
        try:
            sequences.append(FolderSequence(DatasetFolder.open(path), path.name))
        except DatasetError as error:
            gaps.append(Gap(path.name, "", str(error)))
    if not sequences:
        reasons = "; ".join(gap.reason for gap in gaps) or "no folder in it holds frames/ or intrinsics.json"
        raise DatasetError(f"{root}: no frames/ in it, and no data set folder below it: {reasons}")
    return EvaluationSet(name, tuple(sequences), f"{len(sequences)} folders", tuple(gaps))


def _looks_like_data(path: Path) -> bool:
    return (path / "frames").is_dir() or (path / "intrinsics.json").is_file()

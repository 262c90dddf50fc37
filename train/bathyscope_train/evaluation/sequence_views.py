"""Sequences seen through something: a crop, the first frames only, or the eyes of a system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size, crop_intrinsics
from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.sequences import F32, Crop, EvaluationSequence, Unit

T = TypeVar("T", bound=np.generic)
FRAME_RATE = 25.0
"""Frames a second that a system is told, where a data set does not say."""


@dataclass(frozen=True)
class SequenceView:
    """A sequence, cropped or cut short; implements ``EvaluationSequence``, and ``FrameSequence`` for systems."""

    source: EvaluationSequence
    crop: Crop | None = None
    limit: int | None = None

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    @property
    def frame_names(self) -> Sequence[str]:
        """The source's, up to the limit."""
        return list(self.source.frame_names)[: self.limit]

    @property
    def size(self) -> Size:
        """(height, width) after the crop."""
        if self.crop is None:
            return self.source.size
        return self.crop.bottom - self.crop.top, self.crop.right - self.crop.left

    @property
    def depth_unit(self) -> Unit:
        """The source's."""
        return self.source.depth_unit

    @property
    def pose_unit(self) -> Unit | None:
        """The source's."""
        return self.source.pose_unit

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """The source's."""
        return self.source.depth_range

    @property
    def intrinsics(self) -> F64 | None:
        """With the crop's corner taken off."""
        k = self.source.intrinsics
        return k if k is None or self.crop is None else crop_intrinsics(k, self.crop.left, self.crop.top)

    @property
    def world_from_camera(self) -> F64 | None:
        """Up to the limit."""
        poses = self.source.world_from_camera
        return None if poses is None else poses[: self.limit]

    @property
    def published_crop(self) -> Crop | None:
        """Nothing is left to crop."""
        return None

    @property
    def groups(self) -> Mapping[str, NDArray[np.bool_]]:
        """Up to the limit."""
        return {name: chosen[: self.limit] for name, chosen in self.source.groups.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """The source's."""
        return self.source.notes

    def __len__(self) -> int:
        return len(self.frame_names)

    def image(self, index: int) -> NDArray[np.uint8]:
        """RGB (h, w, 3)."""
        image = self.source.image(index)
        if image.shape[:2] != self.source.size:
            raise DatasetError(
                f"{self.name}, frame {self.frame_names[index]}: image of {image.shape[1]}x{image.shape[0]} pixels, the "
                f"sequence has {self.source.size[1]}x{self.source.size[0]}"
            )
        return image if self.crop is None else _cut(image, self.crop)

    def truth(self, index: int) -> F32 | None:
        """(H, W); a crop needs truth of the size of the images."""
        depth = self.source.truth(index)
        if depth is None or self.crop is None:
            return depth
        if depth.shape != self.source.size:
            raise DatasetError(
                f"{self.name}: the published crop needs truth of the size of the images, got {depth.shape} and "
                f"{self.source.size}"
            )
        return _cut(depth, self.crop)

    def time_s(self, index: int) -> float:
        """25 frames a second."""
        return index / FRAME_RATE


def _cut(pixels: NDArray[T], crop: Crop) -> NDArray[T]:
    return np.ascontiguousarray(pixels[crop.top : crop.bottom, crop.left : crop.right])

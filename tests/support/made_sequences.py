"""Sequences with true depth that tests make up in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.sequences import Crop, Unit


@dataclass
class MadeSequence:
    """An evaluation sequence of arrays; frames named in ``unreadable`` raise when their truth is read."""

    depth: np.ndarray
    """(t, H, W); a frame of zeros only has no truth."""
    name: str = "made"
    depth_unit: Unit = "mm"
    pose_unit: Unit | None = None
    depth_range: tuple[float, float] | None = None
    intrinsics: np.ndarray | None = None
    world_from_camera: np.ndarray | None = None
    published_crop: Crop | None = None
    groups: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    unreadable: frozenset[int] = frozenset()

    @property
    def frame_names(self) -> Sequence[str]:
        return [f"{index:04d}" for index in range(len(self.depth))]

    @property
    def size(self) -> tuple[int, int]:
        return self.depth.shape[1], self.depth.shape[2]

    def image(self, index: int) -> np.ndarray:
        return np.full((*self.size, 3), 100 + index, np.uint8)

    def truth(self, index: int) -> np.ndarray | None:
        if index in self.unreadable:
            raise DatasetError(f"{self.name}/{index:04d}.png: not a readable image")
        return self.depth[index].astype(np.float32) if self.depth[index].any() else None

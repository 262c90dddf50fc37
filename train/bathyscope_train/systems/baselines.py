"""The two guesses that need no network, as systems."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope_train.evaluation.baselines import brightness_depth, constant_depth
from bathyscope_train.systems.system import FrameEstimate, SystemInfo


@dataclass(frozen=True, slots=True)
class Baseline:
    """Depth of a frame from the frame alone."""

    name: str
    guess: Callable[[NDArray[np.uint8]], F64]
    """RGB (h, w, 3) to depth (h, w)."""

    @property
    def info(self) -> SystemInfo:
        """Relative depth and nothing else."""
        return SystemInfo(name=self.name, quantity="depth", scale="relative")

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`; intrinsics are of no use to it."""
        everywhere = np.ones(frames.size, np.bool_)
        for index in range(len(frames)):
            yield FrameEstimate(index, self.guess(frames.image(index)).astype(np.float32), everywhere)


BASELINES: Mapping[str, Baseline] = MappingProxyType(
    {"constant": Baseline("constant", constant_depth), "brightness": Baseline("brightness", brightness_depth)}
)
"""By the name that the user gives."""

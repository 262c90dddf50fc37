"""The pixels on which one predicted frame meets its truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bathyscope.errors import DatasetError
from bathyscope_train.evaluation.protocols import Protocol, Quirk
from bathyscope_train.evaluation.resampling import depth_at
from bathyscope_train.evaluation.sequences import MILLIMETRES, EvaluationSequence

F32 = NDArray[np.float32]
Quantity = Literal["depth", "disparity"]
_LEAST, _MOST = 1e-6, 1e5
"""Between these aligned depth is kept, in the unit of the numbers, where the data set has no cap."""
_DISPARITY_FLOOR = np.float32(1e-3)


@dataclass(frozen=True, slots=True)
class Caps:
    """Depths that count, in the unit of the numbers: truth strictly inside, aligned depth clipped."""

    low: float
    high: float

    def inside(self, depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Where true depth counts; NaN and 0 do not."""
        return np.asarray((depth > self.low) & (depth < self.high))

    def clip(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Aligned depth between the caps, and positive and finite where a cap is missing."""
        return np.clip(np.asarray(depth, np.float64), max(self.low, _LEAST), min(self.high, _MOST))


@dataclass(frozen=True, slots=True)
class Scene:
    """What all frames of a sequence share: the unit in which they are measured, and the caps in it."""

    unit: Literal["mm", "arbitrary"]
    factor: float
    """Turns stored truth into ``unit``."""
    caps: Caps

    @classmethod
    def of(cls, sequence: EvaluationSequence, protocol: Protocol) -> Scene:
        """Truth in centimetres and metres is measured in millimetres, so that data sets can be compared.

        Raises:
            DatasetError: If the protocol caps depth in millimetres and the truth is not known in any unit of length.
        """
        factor = MILLIMETRES.get(sequence.depth_unit)
        if protocol.caps_mm is not None:
            if factor is None:
                low, high = protocol.caps_mm
                raise DatasetError(
                    f"{sequence.name}: caps of {low:g} to {high:g} mm need truth in a unit of length, it is arbitrary"
                )
            return cls("mm", factor, Caps(*protocol.caps_mm))
        low, high = sequence.depth_range or (0.0, np.inf)
        scale = 1.0 if factor is None else factor
        return cls("arbitrary" if factor is None else "mm", scale, Caps(max(low, 0.0) * scale, high * scale))


@dataclass(frozen=True, slots=True)
class FramePixels:
    """One frame: maps at the size of the truth, and which of their pixels count."""

    true: F32
    """(H, W) in the unit of the scene."""
    counts: NDArray[np.bool_]
    """(H, W) true depth inside the caps."""
    depth: F32
    """(H, W) predicted depth, not aligned; 0 where there is none, infinite where disparity is 0."""
    predicted: NDArray[np.bool_]
    """(H, W) where there is a prediction."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """(H, W) pixels that are measured."""
        return self.counts & self.predicted

    @property
    def coverage(self) -> float:
        """Share of the pixels with truth that have a prediction; NaN without truth."""
        total = int(self.counts.sum())
        return int(self.used.sum()) / total if total else float("nan")

    def pairs(self) -> tuple[F32, F32]:
        """True and predicted depth (n,) of the pixels that are measured."""
        used = self.used
        return self.true[used], self.depth[used]


@dataclass(frozen=True, slots=True)
class FrameValues:
    """What a system says of one frame."""

    values: F32
    """(h, w) depth or disparity."""
    valid: NDArray[np.bool_]
    """(h, w) where the values mean something."""
    quantity: Quantity
    millimetres: float | None = None
    """In one unit of predicted depth, where it has one."""


def frame_pixels(true: F32 | None, predicted: FrameValues, scene: Scene, protocol: Protocol) -> FramePixels:
    """Bring prediction and truth of one frame to one size and unit.

    Args:
        true: (H, W) as the data set stores it; ``None`` without truth, for which nothing counts.
        predicted: What the system says.
        scene: Unit and caps.
        protocol: Order of resizing, quirks.
    """
    stored = np.zeros(predicted.values.shape, np.float32) if true is None else true
    metric = stored if scene.factor == 1.0 else stored * np.float32(scene.factor)
    values = predicted.values
    if Quirk.DISPARITY_FLOOR in protocol.quirks and predicted.quantity == "disparity":
        values = np.maximum(values, _DISPARITY_FLOOR)
    size = (stored.shape[0], stored.shape[1])
    depth, known = depth_at(values, predicted.valid, predicted.quantity, size, protocol.resize)
    if predicted.millimetres not in (None, 1.0) and scene.unit == "mm":
        depth = depth * np.float32(predicted.millimetres)
    if Quirk.HOLES_CLIPPED in protocol.quirks:
        known = np.ones_like(known)
    return FramePixels(metric, scene.caps.inside(metric), depth, known)

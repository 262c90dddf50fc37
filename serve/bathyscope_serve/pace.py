"""Which frames of a video are far enough apart to be compared."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from bathyscope.vision.field_of_view import BLACK, Mask
from bathyscope.vision.motion import MotionMeter
from bathyscope_serve.engine_settings import PaceSettings
from bathyscope_serve.session import SmallFrame

_FEW = 0.001  # share of a picture


def paced(
    frames: Iterable[tuple[SmallFrame, bool]], settings: PaceSettings, inside: Mask
) -> Iterator[tuple[SmallFrame, bool, bool]]:
    """Frames, each with whether it begins a shot and whether it is a key frame.

    A black frame is none just because it looks different.

    Args:
        frames: Each with whether it begins a shot.
        settings: How far key frames lie apart.
        inside: (h, w) the field of view.
    """
    meter = MotionMeter(inside)
    since = 0
    for number, (frame, begins) in enumerate(frames):
        since += 1
        key = number == 0 or begins or since >= settings.longest
        key = key or (not _is_black(frame.image, inside) and meter.since(frame.image) >= settings.motion)
        if key:
            meter.keep(frame.image)
            since = 0
        yield frame, begins, key


def _is_black(image: NDArray[np.float32], inside: Mask) -> bool:
    return float((image[:, inside] > BLACK / 255).mean()) < _FEW

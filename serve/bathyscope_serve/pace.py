"""Which frames of a video are far enough apart to be compared."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from bathyscope.vision.field_of_view import Mask
from bathyscope.vision.motion import MotionMeter
from bathyscope_serve.engine_settings import PaceSettings
from bathyscope_serve.session import SmallFrame


def paced(
    frames: Iterable[tuple[SmallFrame, bool]], settings: PaceSettings, inside: Mask
) -> Iterator[tuple[SmallFrame, bool, bool]]:
    """Frames, each with whether it begins a shot and whether it is a key frame.

    Args:
        frames: Each with whether it begins a shot.
        settings: How far key frames lie apart.
        inside: (h, w) the field of view.
    """
    meter = MotionMeter(inside)
    since = 0
    for number, (frame, begins) in enumerate(frames):
        since += 1
        key = number == 0 or begins or since >= settings.longest or meter.since(frame.image) >= settings.motion
        if key:
            meter.keep(frame.image)
            since = 0
        yield frame, begins, key

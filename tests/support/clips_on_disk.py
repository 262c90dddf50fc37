"""Small clips as files."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray


def pictures(frames: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(t, h, w, 3) RGB; frame t is of one colour, whose red grows with t."""
    video = np.zeros((frames, *size, 3), np.uint8)
    video[..., 0] = (20 * np.arange(frames) % 240)[:, None, None]
    video[..., 2] = 100
    return video


def write_video(
    path: Path, frames: int = 4, size: tuple[int, int] = (24, 32), times_s: list[float] | None = None
) -> Path:
    """An H.264 file at 25 frames a second, or at the given times."""
    with av.open(path, "w") as container:
        stream = container.add_stream("h264", rate=25)
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for t, image in enumerate(pictures(frames, size)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base = Fraction(1, 1000)
            frame.pts = round(1000 * (times_s[t] if times_s else t / 25))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_images(folder: Path, frames: int = 4, size: tuple[int, int] = (24, 32)) -> Path:
    """``f0.png``, ``f1.png`` ... ``f10.png``: natural order is not alphabetical."""
    folder.mkdir()
    for t, image in enumerate(pictures(frames, size)):
        assert cv2.imwrite(str(folder / f"f{t}.png"), image[..., ::-1])
    return folder

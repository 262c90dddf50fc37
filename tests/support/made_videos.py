"""Small videos, good and bad, written on the fly."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray


def ramp(index: int, size: tuple[int, int] = (48, 64)) -> NDArray[np.uint8]:
    """Smooth colours that survive a codec, brighter with every frame: blue is 40 + 4 index."""
    h, w = size
    y, x = np.mgrid[:h, :w]
    image = np.stack([60 + 120 * x / w, 60 + 120 * y / h, np.full((h, w), 40 + 4 * index)], -1)
    return image.astype(np.uint8)


def write_video(
    path: Path,
    frames: Iterable[NDArray[np.uint8]],
    *,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    times: list[Fraction] | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    """Write RGB frames, 25 a second or at the given times (multiples of a millisecond)."""
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.pix_fmt = pixels
        for index, image in enumerate(frames):
            if index == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.time_base = Fraction(1, 1000)
            frame.pts = int((times[index] if times else Fraction(index, 25)) * 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_audio(path: Path) -> Path:
    """A second of silence and no picture."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        for _ in range(20):
            frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
            frame.rate = 44100
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def turn_display(path: Path, turned: Path) -> Path:
    """The same mp4 with a display matrix for a quarter turn clockwise, as telephones write it."""
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4
    matrix = start + 40  # version and flags, times, track, duration, layer, volume (version 0 of the box)
    one, minus = (1 << 16).to_bytes(4, "big"), (-(1 << 16) & 0xFFFFFFFF).to_bytes(4, "big")
    nought, last = bytes(4), (1 << 30).to_bytes(4, "big")
    data[matrix : matrix + 36] = b"".join([nought, one, nought, minus, nought, nought, nought, nought, last])
    turned.write_bytes(data)
    return turned

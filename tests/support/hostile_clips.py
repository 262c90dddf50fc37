"""Files that a service must refuse, or answer in part and say so."""

import io
import struct
import tempfile
import zipfile
import zlib
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def video(
    frames: int = 8,
    size: tuple[int, int] = (48, 64),
    *,
    codec: str = "h264",
    pixels: str = "yuv420p",
    container: str = "mp4",
    black: bool = False,
    options: dict[str, str] | None = None,
) -> bytes:
    """An ordinary video, with the index at its start; ``black`` makes it tiny whatever its size."""
    random = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video"
        placing = {"movflags": "+faststart"} if container == "mp4" else {}
        with av.open(path, "w", format=container, options=placing) as target:
            stream = target.add_stream(codec, rate=25, options=options or {})
            stream.height, stream.width = size
            stream.pix_fmt = pixels
            image = np.zeros((*size, 3), np.uint8)
            for t in range(frames):
                if not black:
                    image = random.integers(0, 255, (*size, 3), np.uint8)
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts, frame.time_base = t, Fraction(1, 25)
                target.mux(stream.encode(frame))
            target.mux(stream.encode(None))
        return path.read_bytes()


def sound() -> bytes:
    """An mp4 with nothing but a tone."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as target:
        stream = target.add_stream("aac", rate=16000, layout="mono")
        tone = np.sin(np.arange(1024 * 8) / 20).astype(np.float32)[None]
        for part in np.split(tone, 8, axis=1):
            frame = av.AudioFrame.from_ndarray(part, format="fltp", layout="mono")
            frame.sample_rate = 16000
            target.mux(stream.encode(frame))
        target.mux(stream.encode(None))
    return file.getvalue()


def flipped(data: bytes, share: float = 2e-3) -> bytes:
    """The same with some bits of the picture data flipped; the index at the start stays whole."""
    damaged = bytearray(data)
    begin = damaged.index(b"mdat") + 4
    random = np.random.default_rng(0)
    for place in random.integers(begin, len(damaged), int(share * len(damaged))):
        damaged[place] ^= 1 << int(random.integers(8))
    return bytes(damaged)


def zipped(members: dict[str, bytes]) -> bytes:
    """A zip of these members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def black_png(size: tuple[int, int]) -> bytes:
    """A black picture of one bit a pixel: eight thousand times smaller than its RGB."""
    h, w = size

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = zlib.compress(bytes(h * (1 + (w + 7) // 8)), 9)
    header = struct.pack(">IIBBBBB", w, h, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")

"""The grey PNG codec, against Pillow and OpenCV."""

from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from bathyscope.errors import ResultError
from bathyscope.png import decode_grey, encode_grey

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)
IMAGES = st.one_of(hnp.arrays(np.uint8, SHAPES), hnp.arrays(np.uint16, SHAPES))


def smooth(dtype: type) -> np.ndarray:
    y, x = np.mgrid[:37, :53]
    return (np.iinfo(dtype).max * (0.5 + 0.4 * np.sin(x / 9) * np.cos(y / 7))).astype(dtype)


def with_filter(image: np.ndarray, kind: int) -> bytes:
    """A PNG whose every row uses one filter, written from the format's definition byte by byte."""
    h, w = image.shape
    step = image.dtype.itemsize
    rows = image.astype(image.dtype.newbyteorder(">")).tobytes()
    stride = w * step
    body = bytearray()
    for y in range(h):
        body.append(kind)
        for x in range(stride):
            left = rows[y * stride + x - step] if x >= step else 0
            up = rows[(y - 1) * stride + x] if y else 0
            body.append((rows[y * stride + x] - {0: 0, 1: left, 2: up, 3: (left + up) // 2}[kind]) % 256)
    return png((w, h, 8 * step, 0, 0, 0, 0), zlib.compress(bytes(body)))


def png(header: tuple[int, ...], data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    start = chunk(b"IHDR", struct.pack(">IIBBBBB", *header))
    return b"\x89PNG\r\n\x1a\n" + start + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@given(IMAGES)
@settings(deadline=None)
def test_what_is_written_reads_back_the_same(image: np.ndarray) -> None:
    decoded = decode_grey(encode_grey(image))
    assert decoded.dtype == image.dtype
    np.testing.assert_array_equal(decoded, image)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pillow_and_opencv_read_what_we_write(dtype: type) -> None:
    image = smooth(dtype)
    data = encode_grey(image)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), image)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), image)


@pytest.mark.parametrize("kind", [0, 1, 2], ids=["none", "sub", "up"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_rows_filtered_by_others_are_read(dtype: type, kind: int) -> None:
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (11, 7)).astype(dtype)
    np.testing.assert_array_equal(decode_grey(with_filter(image, kind)), image)


def test_a_filter_that_is_not_read_is_named() -> None:
    with pytest.raises(ResultError, match="row filter 3 is not read"):
        decode_grey(with_filter(smooth(np.uint8), 3))


def test_a_sloping_plane_becomes_much_smaller_than_its_pixels() -> None:
    y, x = np.mgrid[:120, :160]
    image = (37 * y + 11 * x).astype(np.uint16)
    assert len(encode_grey(image)) < 0.1 * image.nbytes


@pytest.mark.parametrize(
    "image",
    [np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), np.zeros((0, 3), np.uint8), np.zeros(4, np.uint16)],
    ids=["colour", "float", "empty", "one axis"],
)
def test_only_grey_images_of_whole_numbers_are_written(image: np.ndarray) -> None:
    with pytest.raises(ResultError, match="a grey PNG needs"):
        encode_grey(image)


@pytest.mark.parametrize(
    "header",
    [
        (4, 4, 8, 2, 0, 0, 0),
        (4, 4, 4, 0, 0, 0, 0),
        (4, 4, 8, 0, 0, 0, 1),
        (0, 4, 8, 0, 0, 0, 0),
        (1 << 16, 1 << 16, 8, 0, 0, 0, 0),
    ],
    ids=["colour", "4 bits", "interlaced", "empty", "too large"],
)
def test_other_kinds_of_png_are_refused(header: tuple[int, ...]) -> None:
    with pytest.raises(ResultError, match="PNG must be plain grey"):
        decode_grey(png(header, zlib.compress(bytes(100))))


def test_image_data_that_would_unpack_to_much_more_than_the_image_cost_no_memory() -> None:
    bomb = png((4, 4, 8, 0, 0, 0, 0), zlib.compress(bytes(50_000_000)))
    np.testing.assert_array_equal(decode_grey(bomb), np.zeros((4, 4)))


def test_too_little_image_data_is_an_error() -> None:
    with pytest.raises(ResultError, match="holds 10 bytes of rows, 20 are needed"):
        decode_grey(png((4, 4, 8, 0, 0, 0, 0), zlib.compress(bytes(10))))


@given(st.integers(0, 10_000), st.integers(1, 255))
@settings(deadline=None)
def test_a_changed_byte_is_an_error(position: int, change: int) -> None:
    data = bytearray(encode_grey(smooth(np.uint8)))
    data[position % len(data)] ^= change
    with pytest.raises(ResultError):
        decode_grey(bytes(data))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.99])
def test_a_file_cut_short_is_an_error(share: float) -> None:
    data = encode_grey(smooth(np.uint16))
    with pytest.raises(ResultError):
        decode_grey(data[: int(share * len(data))])

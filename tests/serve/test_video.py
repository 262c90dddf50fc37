"""Decoding what comes from outside: times, sizes, limits, damage."""

from __future__ import annotations

import contextlib
import io
import os
import random
import signal
import subprocess
import sys
import zipfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from made_videos import ramp, turn_display, write_audio, write_video

from bathyscope.errors import ClipError
from bathyscope_serve.decode_limits import DecodeLimits
from bathyscope_serve.decoder import open_reader
from bathyscope_serve.frames import Frame, SourceReport
from bathyscope_serve.images import natural_key
from bathyscope_serve.isolation import open_source


def read(source: Path, **limits: float) -> tuple[list[Frame], SourceReport]:
    """Decode in this process: what the decoding process does, without the time that starting one takes."""
    with contextlib.ExitStack() as stack:
        descriptor = source if source.is_dir() else stack.enter_context(source.open("rb")).fileno()
        reader = open_reader(descriptor, source.stem, DecodeLimits.model_validate(limits))
        frames = [Frame(i, decoded.timestamp_s, decoded.image) for i, decoded in enumerate(reader.frames())]
        tally = reader.tally
        return frames, SourceReport(tally.complete and not tally.corrupt, tally.summary())


def read_isolated(source: Path | io.BytesIO, **limits: float) -> tuple[list[Frame], SourceReport]:
    with open_source(source, limits=DecodeLimits.model_validate(limits)) as opened:
        frames = list(opened)
        assert {frame.image.shape for frame in frames} == {(*opened.size, 3)}
        return frames, opened.report()


def video(tmp_path: Path, count: int = 10, **how: str) -> Path:
    return write_video(tmp_path / "clip.mp4", (ramp(i) for i in range(count)), **how)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "mpeg4", "yuv420p"),
        ("a.mkv", "ffv1", "bgr0"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
    ],
)
def test_every_container_gives_its_pictures_back(tmp_path: Path, name: str, codec: str, pixels: str) -> None:
    path = write_video(tmp_path / name, (ramp(i, (50, 62)) for i in range(6)), codec=codec, pixels=pixels)
    frames, report = read(path)
    assert report == SourceReport(complete=True, warnings=[])
    assert [frame.index for frame in frames] == list(range(6))
    for i, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - ramp(i, (50, 62))).mean() < 6


def test_variable_frame_rate_keeps_its_time_stamps(tmp_path: Path) -> None:
    times = [Fraction(t, 1000) for t in (0, 40, 55, 300, 301, 900)]
    path = write_video(tmp_path / "clip.mp4", (ramp(i) for i in range(6)), times=times)
    frames, _ = read(path)
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], [float(t) for t in times], atol=1e-6)


def test_a_picture_taken_upright_is_decoded_upright(tmp_path: Path) -> None:
    frames, _ = read(turn_display(video(tmp_path, 3), tmp_path / "turned.mp4"))
    expected = np.rot90(ramp(0), -1)
    assert frames[0].image.shape == (64, 48, 3)
    assert np.abs(frames[0].image.astype(int) - expected).mean() < 6


def test_one_frame_is_a_clip(tmp_path: Path) -> None:
    frames, report = read(video(tmp_path, 1))
    assert len(frames) == 1
    assert report.complete


def test_an_open_file_is_as_good_as_a_path(tmp_path: Path) -> None:
    path = video(tmp_path, 4)
    here, _ = read(path)
    for source in (path, io.BytesIO(path.read_bytes())):
        there, report = read_isolated(source)
        assert report.complete
        for a, b in zip(here, there, strict=True):
            assert (a.index, a.timestamp_s) == (b.index, b.timestamp_s)
            np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.mp4", b"", "empty"),
        ("text.mp4", b"these are words\n" * 200, "not a video"),
        ("zeros.avi", bytes(4096), "not a video"),
        ("list.mp4", b"ffconcat version 1.0\nfile '{other}'\n", "not a video"),
        ("list.m3u8", b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{other}\n#EXT-X-ENDLIST\n", "not a video"),
        ("half.zip", b"PK\x03\x04" + bytes(100), "zip"),
    ],
)
def test_what_is_no_video_is_refused_and_leads_nowhere(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    other = video(tmp_path)
    path = tmp_path / name
    path.write_bytes(content.replace(b"{other}", str(other).encode()))
    with pytest.raises(ClipError, match=message) as caught:
        read(path)
    assert path.stem in str(caught.value)


def test_audio_only_says_so(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match=r"no video stream \(container mov, audio only\)"):
        read(write_audio(tmp_path / "a.mp4"))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"frame_pixels": 2000}, "64x48"),
        ({"side_pixels": 63}, "64x48"),
        ({"least_side_pixels": 49}, "at least 49"),
        ({"frames": 9}, "at most 9"),
        ({"duration_s": 0.2}, "at most 0 s"),
        ({"total_pixels": 64 * 48 * 9}, "decode to"),
        ({"free_pixels": 1, "pixels_per_byte": 1}, "decode to"),
        ({"file_bytes": 100}, "at most 100"),
    ],
)
def test_limits_refuse_before_a_frame_is_handed_out(tmp_path: Path, limits: dict[str, float], message: str) -> None:
    path = video(tmp_path)
    with path.open("rb") as file, pytest.raises(ClipError, match=message):
        open_reader(file.fileno(), "clip", DecodeLimits.model_validate(limits))


def test_limits_hold_where_the_container_declares_nothing(tmp_path: Path) -> None:
    """Matroska counts no frames, so only decoding tells."""
    path = write_video(tmp_path / "a.mkv", (ramp(i) for i in range(10)), codec="ffv1", pixels="bgr0")
    with pytest.raises(ClipError, match="more than 6"):
        read(path, frames=6)


def test_a_small_file_of_many_black_4k_frames_is_refused(tmp_path: Path) -> None:
    black = np.zeros((2160, 3840, 3), np.uint8)
    path = write_video(tmp_path / "bomb.mp4", (black for _ in range(3)), codec="mpeg4")
    with pytest.raises(ClipError, match="may hold"):
        read(path, free_pixels=8_000_000, pixels_per_byte=1)


@pytest.mark.parametrize(
    ("misuse", "outcome"),
    [
        ("while True: pass", -signal.SIGXCPU),
        ("bytearray(3 << 30)", "MemoryError"),
        ("open(sys.argv[1], 'w').write('x' * 99999)", "File too large"),
        ("[os.dup(1) for _ in range(99)]", "Too many open files"),
    ],
    ids=["time", "memory", "disk", "files"],
)
def test_a_decoding_process_that_is_taken_over_can_use_up_little(
    tmp_path: Path, misuse: str, outcome: int | str
) -> None:
    code = (
        "import os, sys, signal; from bathyscope_serve.decoder import confine; "
        "from bathyscope_serve.decode_limits import DecodeLimits; confine(DecodeLimits(cpu_s=1)); "
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n" + misuse
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "x")], capture_output=True, text=True, timeout=120, check=False
    )
    if isinstance(outcome, str):
        assert outcome in done.stderr
    else:
        assert done.returncode == outcome


def test_a_decoder_that_does_not_answer_is_given_up(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="stalled"):
        read_isolated(video(tmp_path), wait_s=0.01)


def test_a_killed_decoder_leaves_what_was_decoded(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", (ramp(i % 40, (240, 320)) for i in range(40)), codec="mpeg4")
    with open_source(path) as source:
        frames = iter(source)
        next(frames)
        os.killpg(source._process.pid, 9)
        rest = list(frames)
        assert len(rest) < 39
        assert not source.report().complete
        assert "SIGKILL" in source.report().warnings[0]


def test_closing_early_leaves_no_process(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", (ramp(i % 40, (240, 320)) for i in range(40)), codec="mpeg4")
    with open_source(path) as source:
        next(iter(source))
    assert source._process.returncode is not None


def test_a_truncated_file_gives_what_it_holds_and_says_so(tmp_path: Path) -> None:
    path = video(tmp_path, 40, options={"movflags": "faststart"})  # type: ignore[arg-type]
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    frames, report = read(path)
    assert 0 < len(frames) < 40
    assert not report.complete
    assert "declares 40 frames" in report.warnings[0]


def test_a_file_without_its_index_is_refused(tmp_path: Path) -> None:
    path = video(tmp_path, 40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ClipError, match="not a video"):
        read(path)


@pytest.mark.parametrize("seed", range(3))
def test_flipped_bits_are_an_error_or_a_result_that_says_so(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(12)]
    path = write_video(tmp_path / "a.mp4", noise, options={"movflags": "faststart"})
    data = bytearray(path.read_bytes())
    chance = random.Random(seed)
    for _ in range(200):
        place = chance.randrange(2500, len(data))
        data[place] ^= 1 << chance.randrange(8)
    path.write_bytes(data)
    frames, report = read(path)
    assert 0 < len(frames) <= 12
    assert not report.complete
    assert "damaged" in report.warnings[-1]


def test_the_survey_sees_what_is_bright_anywhere(tmp_path: Path) -> None:
    path = video(tmp_path, 30)
    with open_source(path) as source:
        survey = source.survey()
    assert survey.frames >= 4
    expected = np.max([ramp(i).max(-1) for i in range(30)], 0)
    assert np.abs(survey.brightest.astype(int) - expected).mean() < 25


def image_bytes(index: int, size: tuple[int, int] = (48, 64), codec: str = "png") -> bytes:
    context = av.CodecContext.create(codec, "w")
    context.height, context.width = size
    context.pix_fmt = "rgb24" if codec == "png" else "yuvj444p"
    context.time_base = Fraction(1, 25)
    packets = context.encode(av.VideoFrame.from_ndarray(ramp(index, size), format="rgb24"))
    return b"".join(bytes(packet) for packet in [*packets, *context.encode(None)])


@pytest.mark.parametrize("packed", [False, True], ids=["folder", "zip"])
def test_images_come_in_natural_order(tmp_path: Path, packed: bool) -> None:
    names = ["frame10.png", "frame2.png", "frame1.PNG"]
    content = {name: image_bytes(int(name[5:-4])) for name in names} | {"notes.txt": b"about them"}
    source = tmp_path / ("images.zip" if packed else "images")
    if packed:
        with zipfile.ZipFile(source, "w") as archive:
            for name, data in content.items():
                archive.writestr(f"shot/{name}", data)
    else:
        source.mkdir()
        for name, data in content.items():
            (source / name).write_bytes(data)
    frames, report = read(source)
    for frame, index in zip(frames, (1, 2, 10), strict=True):
        np.testing.assert_array_equal(frame.image, ramp(index))
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], [0, 0.04, 0.08])
    assert report.complete
    assert "no time stamps" in report.warnings[0]


def test_a_jpeg_is_decoded(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(image_bytes(3, codec="mjpeg"))
    frames, _ = read(tmp_path)
    assert np.abs(frames[0].image.astype(int) - ramp(3)).mean() < 6


def test_a_damaged_image_is_left_out_and_said(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(image_bytes(i))
    (tmp_path / "1.png").write_bytes(b"no image at all")
    frames, report = read(tmp_path)
    assert len(frames) == 2
    assert not report.complete
    np.testing.assert_allclose(frames[1].timestamp_s, 0.08)


def test_images_of_two_sizes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(image_bytes(0))
    (tmp_path / "b.png").write_bytes(image_bytes(1, (40, 64)))
    with pytest.raises(ClipError, match=r"a\.png is 64x48, b\.png is 64x40"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "x/../../a.png"])
def test_a_zip_whose_names_leave_it_is_refused(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name, image_bytes(0))
    with pytest.raises(ClipError, match="leaves the zip"):
        read(tmp_path / "a.zip")


def test_a_zip_of_large_black_images_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.png", image_bytes(0, (200, 300)))
    with pytest.raises(ClipError, match="300x200"):
        read(tmp_path / "a.zip", frame_pixels=20_000)


def test_a_refusal_crosses_the_process_border_in_words(tmp_path: Path) -> None:
    with pytest.raises(ClipError, match="no PNG or JPEG"):
        read_isolated(tmp_path)


def test_numbers_in_names_count_as_numbers() -> None:
    names = ["b1", "a10", "a9", "a09b", "a", "10", "9"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "a9", "a09b", "a10", "b1"]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads as Linux shows them")
def test_decoding_starts_no_thread_because_it_may_not_when_confined(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", [ramp(i, (480, 640)) for i in range(4)])
    before = len(os.listdir("/proc/self/task"))
    with path.open("rb") as file:
        for _ in open_reader(file.fileno(), "a", DecodeLimits()).frames():
            assert len(os.listdir("/proc/self/task")) <= before

"""Bad inputs through the whole service with the real decoder: a clear answer to each, and a good one next."""

import io
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from analytic_model import GREY, SPEC, AnalyticModel
from fake_engine import fake_bundle
from hostile_clips import black_png, flipped, sound, video, zipped
from live_server import live_server
from numpy.typing import NDArray
from typer.testing import CliRunner

from bathyscope.bundle import MANIFEST, Bundle, hash_file, write_manifest
from bathyscope.scene import WindowMaps
from bathyscope_serve import cli
from bathyscope_serve.app import create_app
from bathyscope_serve.engine import DepthEngine
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.settings import ServiceSettings

PLAYLIST = b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n#EXT-X-ENDLIST\n"
AVI = {"codec": "mjpeg", "pixels": "yuvj420p", "container": "avi"}
CONCAT = b"ffconcat version 1.0\nfile other.mp4\n"


class SteadyModel(AnalyticModel):
    """Takes every window for the first frames of its plane, so that the same clip always has the same answer."""

    def predict(
        self,
        images: NDArray[np.float32],
        checkpoint: Callable[[], None] = lambda: None,
        *,
        focal: float | None = None,
    ) -> WindowMaps:
        self.windows.clear()
        greys = (GREY + np.arange(len(images), dtype=np.float32)) / 255
        return super().predict(np.broadcast_to(greys[:, None, None, None], images.shape), checkpoint)


class Service:
    """A running service and what it answered to a good clip at first."""

    def __init__(self, url: str, temp: Path) -> None:
        self.http = httpx.Client(base_url=url, timeout=60)
        self.temp = temp
        self.good = video()
        self.expected = self.depth()

    def post(self, content: bytes, content_type: str = "video/mp4", accept: str = "*/*") -> httpx.Response:
        return self.http.post("/depth", content=content, headers={"content-type": content_type, "accept": accept})

    def depth(self) -> np.ndarray:
        answer = self.post(self.good)
        assert answer.status_code == 200, answer.text
        return np.load(io.BytesIO(answer.content), allow_pickle=False)["depth"]

    def check_still_well(self) -> None:
        """It takes clips, and nothing is left of the last one."""
        assert self.http.get("/readyz").status_code == 200
        end = time.monotonic() + 10
        while (left := [path for path in self.temp.rglob("*") if path.is_file()]) and time.monotonic() < end:
            time.sleep(0.01)
        assert not left


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    temp = tmp_path_factory.mktemp("temp")
    bundle = fake_bundle()
    manifest = bundle.manifest.model_copy(update={"scene": SPEC})
    engine = DepthEngine(
        Bundle(bundle.folder, manifest, bundle.digest),
        EngineSettings(window=4, overlap=1, pixels=42 * 56),
        model=SteadyModel(),
    )
    with live_server(create_app(engine, ServiceSettings(temp=temp))) as (host, port):
        yield Service(f"http://{host}:{port}", temp)


def bomb() -> bytes:
    data = video(40, (2160, 3840), black=True, options={"preset": "ultrafast"})
    assert len(data) < 28_000, "a gigabyte of pixels in 27 KB"
    return data


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty file": (lambda: b"", "empty"),
    "sound only": (sound, "audio only"),
    "text named mp4": (lambda: b"Dear doctor, " * 100, "not a video"),
    "random bytes": (lambda: np.random.default_rng(1).bytes(5000), "not a video"),
    "cut within the index": (lambda: video()[:200], "no video stream"),
    "playlist": (lambda: PLAYLIST, "not a video"),
    "list of files": (lambda: CONCAT, "not a video"),
    "8 pixels high": (lambda: video(3, (8, 64)), "at least"),
    "picture of 8192 x 8192": (lambda: zipped({"a.png": black_png((8192, 8192))}), "8192x8192"),
    "zip without images": (lambda: zipped({"readme.txt": b"hello"}), "no PNG or JPEG"),
    "zip that leaves its folder": (lambda: zipped({"../a.png": b"x"}), "leaves the zip"),
    "zip of damaged images": (lambda: zipped({"a.png": b"\x89PNG\r\n\x1a\n"}), "no frame"),
    "end of a zip": (lambda: b"PK\x05\x06", "zip"),
}
SLOW_TO_MAKE: dict[str, tuple[Callable[[], bytes], str]] = {
    "video of 8192 x 8192": (lambda: video(1, (8192, 8192), black=True, **AVI), "8192x8192"),
    "bomb of black frames": (bomb, "pixels"),
}
NAMES = [*REFUSED, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW_TO_MAKE)]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_no_clip_is_refused_in_words(service: Service, name: str) -> None:
    make, words = (REFUSED | SLOW_TO_MAKE)[name]
    content = make()
    began = time.monotonic()
    answer = service.post(content)
    assert time.monotonic() - began < 30, "a refusal comes quickly"
    assert answer.status_code == 422, answer.text
    assert words in answer.json()["detail"]
    assert str(service.temp) not in answer.text, "no path of the server in an answer"
    service.check_still_well()


def test_a_good_clip_has_the_same_answer_after_bad_ones(service: Service) -> None:
    for content in (b"", sound(), flipped(service.good, 0.05), service.good[: len(service.good) // 2]):
        service.post(content)
    np.testing.assert_array_equal(service.depth(), service.expected)


def test_a_wrong_content_type_is_refused(service: Service) -> None:
    assert service.post(service.good, "text/html").status_code == 415
    service.check_still_well()


def test_a_video_cut_short_gives_what_is_there_and_says_so(service: Service) -> None:
    whole = video(40)
    answer = service.post(whole[: len(whole) // 2], accept="application/json")
    assert answer.status_code == 200, answer.text
    meta, frames = answer.json()["meta"], answer.json()["frames"]
    assert 5 < len(frames) < 40
    assert meta["complete"] is False
    assert any("cut short" in warning for warning in meta["warnings"])
    service.check_still_well()


def test_flipped_bits_are_counted(service: Service) -> None:
    answer = service.post(flipped(video(20)), accept="application/json")
    assert answer.status_code == 200, answer.text
    meta = answer.json()["meta"]
    assert meta["complete"] is False
    assert any("damaged" in warning for warning in meta["warnings"])
    service.check_still_well()


@pytest.mark.parametrize(
    ("content", "frames", "size"),
    [
        (lambda: video(1), 1, [48, 64]),
        (lambda: video(3, (47, 33), pixels="yuv444p"), 3, [47, 33]),
        (lambda: video(3, **AVI), 3, [48, 64]),
        (lambda: video(3, container="matroska"), 3, [48, 64]),
    ],
    ids=["one frame", "odd size", "avi", "mkv"],
)
def test_unusual_clips_are_served(service: Service, content: Callable[[], bytes], frames: int, size: list[int]) -> None:
    answer = service.post(content(), "application/octet-stream", "application/json")
    assert answer.status_code == 200, answer.text
    assert (len(answer.json()["frames"]), answer.json()["size"]) == (frames, size)
    assert answer.json()["meta"]["complete"] is True


def bundle_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "bundle"
    folder.mkdir()
    for name in ("graph.onnx", "weights.data"):
        (folder / name).write_bytes(b"")
    files = {name: hash_file(folder / name) for name in ("graph.onnx", "weights.data")}
    write_manifest(folder, fake_bundle().manifest.model_copy(update={"files": files}))
    return folder


def changed_byte(folder: Path) -> None:
    (folder / "weights.data").write_bytes(b"x")


def outside(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["weights"] = "../weights.data"
    manifest["files"]["../weights.data"] = manifest["files"].pop("weights.data")
    (folder / MANIFEST).write_text(json.dumps(manifest))


def unreadable_graph(_: Path) -> None:
    """Empty files are no ONNX graphs."""


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder: (folder / MANIFEST).unlink(), "no bundle.json"),
        (changed_byte, "weights.data"),
        (outside, "../weights.data"),
        (unreadable_graph, "graph.onnx"),
    ],
    ids=["no manifest", "changed byte", "weights outside", "no graph"],
)
def test_a_bundle_that_cannot_be_used_ends_the_start_with_code_2(
    tmp_path: Path, spoil: Callable[[Path], None], words: str
) -> None:
    folder = bundle_folder(tmp_path)
    spoil(folder)
    outcome = CliRunner().invoke(cli.app, ["--bundle", str(folder), "--port", "0"])
    assert outcome.exit_code == 2, outcome.output
    assert words in outcome.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--bundle", "nowhere"], "nowhere"),
        (["--workers", "0"], "workers"),
        (["--max-upload-mb", "-1"], "max_upload_mb"),
        (["--temp", "nowhere"], "nowhere"),
    ],
)
def test_settings_that_cannot_be_used_end_the_start_with_code_2(arguments: list[str], words: str) -> None:
    outcome = CliRunner().invoke(cli.app, arguments)
    assert outcome.exit_code == 2
    assert words in outcome.stderr


def test_settings_come_from_the_environment_and_options_win(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BATHYSCOPE_QUEUE", "3")
    monkeypatch.setenv("BATHYSCOPE_MAX_UPLOAD_MB", "2.5")
    settings = ServiceSettings.read(queue=4)
    assert (settings.queue, settings.max_upload_bytes) == (4, 2621440)


def test_a_port_that_is_taken_is_told() -> None:
    with cli.bind("127.0.0.1", 0) as taken:
        from bathyscope.errors import SettingsError

        with pytest.raises(SettingsError, match="cannot listen"):
            cli.bind("127.0.0.1", taken.getsockname()[1])

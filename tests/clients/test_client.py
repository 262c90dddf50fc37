"""The Python client against scripted answers: no network, no service."""

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from fake_engine import fake_bundle, plane

from bathyscope.engines import DepthOptions
from bathyscope.errors import ClipError, ServiceError
from bathyscope.result import ClipDepth, ResultMeta
from bathyscope.result_files import save_npz
from bathyscope_client import DepthClient

Handler = Callable[[httpx.Request], httpx.Response]


def client(handler: Handler, **options: float) -> DepthClient:
    return DepthClient("http://depth.test", transport=httpx.MockTransport(handler), **options)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "colon.mp4"
    path.write_bytes(b"video" * 1000)
    return path


@pytest.fixture
def result(tmp_path: Path) -> ClipDepth:
    return ClipDepth.from_frames([plane(t, (6, 8)) for t in range(3)], ResultMeta(name="colon"))


def npz_bytes(result: ClipDepth, tmp_path: Path) -> bytes:
    return save_npz(tmp_path / "served.npz", result).read_bytes()


def npz_answer(content: bytes | Iterator[bytes]) -> httpx.Response:
    return httpx.Response(200, headers={"content-type": "application/x-npz"}, content=content)


def problem(status: int, detail: str, **headers: str) -> httpx.Response:
    body = {"status": status, "detail": detail, "request_id": "r-1"}
    kinds = {"content-type": "application/problem+json", "x-request-id": "r-1"}
    return httpx.Response(status, headers={**kinds, **headers}, content=json.dumps(body))


def test_a_clip_goes_out_and_its_depth_comes_back(video: Path, result: ClipDepth, tmp_path: Path) -> None:
    seen: dict[str, object] = {}

    def handler(request: httpx.Request) -> httpx.Response:
        seen.update(dict(request.url.params), type=request.headers["content-type"], body=request.read())
        return npz_answer(npz_bytes(result, tmp_path))

    with client(handler) as depth_client:
        clip = depth_client.depth(video, DepthOptions(stride=2), precision="float16")
    np.testing.assert_array_equal(clip.depth, result.depth)
    np.testing.assert_array_equal(clip.world_from_camera, result.world_from_camera)
    assert seen == {
        "stride": "2",
        "depth": "rendered",
        "dtype": "float16",
        "name": "colon.mp4",
        "type": "video/mp4",
        "body": video.read_bytes(),
    }


def test_an_open_file_is_sent_from_where_it_stands(result: ClipDepth, tmp_path: Path) -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        assert request.read() == b"clip"
        assert request.headers["content-length"] == "4"
        return npz_answer(npz_bytes(result, tmp_path))

    file = io.BytesIO(b"skip clip")
    file.seek(5)
    with client(handler) as depth_client:
        assert len(depth_client.depth(file)) == 3


@pytest.mark.parametrize("status", [400, 413, 422, 500, 503])
def test_a_refusal_keeps_status_request_id_and_reason(video: Path, status: int) -> None:
    with client(lambda _: problem(status, "too long by half")) as depth_client, pytest.raises(ServiceError) as caught:
        depth_client.depth(video)
    assert (caught.value.status, caught.value.request_id) == (status, "r-1")
    assert "too long by half" in str(caught.value)


def test_a_failure_that_is_no_problem_document_is_shown_as_it_is(video: Path) -> None:
    page = httpx.Response(502, content=b"<p>bad gateway</p>")
    with client(lambda _: page) as depth_client, pytest.raises(ServiceError, match="bad gateway") as caught:
        depth_client.depth(video)
    assert (caught.value.status, caught.value.request_id) == (502, None)


def test_an_answer_of_another_kind_of_server_is_an_error(video: Path) -> None:
    page = httpx.Response(200, headers={"content-type": "text/html"}, content=b"<p>hello</p>")
    with client(lambda _: page) as depth_client, pytest.raises(ServiceError, match="text/html"):
        depth_client.depth(video)


def broken() -> Iterator[bytes]:
    yield b"PK"
    raise httpx.ReadError("reset by peer")


def test_a_download_that_breaks_leaves_no_file(video: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.npz"
    with client(lambda _: npz_answer(broken())) as depth_client, pytest.raises(ServiceError, match="broke"):
        depth_client.download(video, target)
    assert {path.name for path in tmp_path.iterdir()} == {"colon.mp4"}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (httpx.ConnectError("refused"), "cannot be reached"),
        (httpx.ReadTimeout("slow"), "no answer in time"),
        (httpx.RemoteProtocolError("odd"), "broke"),
    ],
)
def test_transport_failures_are_service_errors_without_status(video: Path, error: Exception, words: str) -> None:
    def handler(_: httpx.Request) -> httpx.Response:
        raise error

    with client(handler) as depth_client, pytest.raises(ServiceError, match=words) as caught:
        depth_client.depth(video)
    assert (caught.value.status, caught.value.request_id) == (None, None)


@pytest.mark.parametrize("url", ["ftp://depth.test", "http://[::bad", "depth"])
def test_a_url_that_is_none_is_a_service_error(url: str) -> None:
    with pytest.raises(ServiceError, match="URL"), DepthClient(url) as depth_client:
        depth_client.ready()


def test_a_missing_file_is_told_without_asking_the_service(tmp_path: Path) -> None:
    def handler(_: httpx.Request) -> httpx.Response:
        raise AssertionError("nothing should be sent")

    with client(handler) as depth_client, pytest.raises(ClipError, match="nowhere"):
        depth_client.depth(tmp_path / "nowhere.mp4")


def test_a_busy_service_is_asked_again_within_the_patience(video: Path, result: ClipDepth, tmp_path: Path) -> None:
    answers = [problem(503, "queue full", **{"retry-after": "0"}), npz_answer(npz_bytes(result, tmp_path))]
    bodies: list[bytes] = []

    def handler(request: httpx.Request) -> httpx.Response:
        bodies.append(request.read())
        return answers.pop(0)

    with client(handler, patience_s=5) as depth_client:
        assert len(depth_client.depth(video)) == 3
    assert bodies == [video.read_bytes()] * 2


def test_patience_ends(video: Path) -> None:
    busy = problem(503, "queue full", **{"retry-after": "60"})
    with client(lambda _: busy, patience_s=5) as depth_client, pytest.raises(ServiceError, match="queue full"):
        depth_client.depth(video)


def test_bundle_is_typed() -> None:
    body = json.dumps({"digest": "f" * 64, "manifest": fake_bundle().manifest.model_dump(mode="json")})
    with client(lambda _: httpx.Response(200, content=body)) as depth_client:
        assert depth_client.bundle().manifest == fake_bundle().manifest
    with (
        client(lambda _: httpx.Response(200, content=b"{}")) as depth_client,
        pytest.raises(ServiceError, match="bundle"),
    ):
        depth_client.bundle()


def test_ready_tells_warming_up_from_failure() -> None:
    for status, ready in ((200, True), (503, False)):
        with client(lambda _, status=status: httpx.Response(status)) as depth_client:  # type: ignore[misc]
            assert depth_client.ready() is ready
    with client(lambda _: httpx.Response(404)) as depth_client, pytest.raises(ServiceError):
        depth_client.ready()


def test_progress_counts_every_byte(video: Path, result: ClipDepth, tmp_path: Path) -> None:
    data = npz_bytes(result, tmp_path)
    sent: list[tuple[int, int | None]] = []
    received: list[tuple[int, int | None]] = []
    with client(lambda request: (request.read(), npz_answer(data))[1]) as depth_client:
        depth_client.download(
            video,
            tmp_path / "r.npz",
            on_sent=lambda done, total: sent.append((done, total)),
            on_received=lambda done, total: received.append((done, total)),
        )
    assert sent[-1] == (5000, 5000)
    assert received[-1] == (len(data), len(data))

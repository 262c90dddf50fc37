"""The HTTP service around a fake engine: forms, options, refusals, what every answer carries."""

import asyncio
import io
import json
import zipfile
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import structlog
from fake_engine import BREAKS, NOT_A_CLIP, FakeEngine, plane

from bathyscope.result_files import load_npz
from bathyscope.result_zip import load_zip
from bathyscope_serve.app import create_app
from bathyscope_serve.settings import ServiceSettings

MP4 = {"content-type": "video/mp4"}
Talk = Callable[[httpx.AsyncClient], Coroutine[Any, Any, Any]]


def talk(tmp_path: Path, conversation: Talk, engine: FakeEngine | None = None, **settings: Any) -> Any:
    """Run a conversation with a started service; afterwards no temporary file may be left."""

    async def run() -> Any:
        app = create_app(engine or FakeEngine(), ServiceSettings(temp=tmp_path, **settings))
        transport = httpx.ASGITransport(app=app, raise_app_exceptions=False)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://t") as http,
        ):
            while app.state.service.state == "starting":
                await asyncio.sleep(0.001)
            answer = await conversation(http)
            (root,) = tmp_path.iterdir()
            assert list(root.iterdir()) == []
        assert list(tmp_path.iterdir()) == []
        return answer

    return asyncio.run(run())


def post(
    tmp_path: Path, engine: FakeEngine | None = None, settings: dict[str, Any] | None = None, **request: Any
) -> httpx.Response:
    url = request.pop("url", "/depth")

    async def conversation(http: httpx.AsyncClient) -> httpx.Response:
        return await http.post(url, **request)

    answer = talk(tmp_path, conversation, engine, **(settings or {}))
    assert isinstance(answer, httpx.Response)
    return answer


def get(tmp_path: Path, url: str, **request: Any) -> httpx.Response:
    answer = talk(tmp_path, lambda http: http.get(url, **request))
    assert isinstance(answer, httpx.Response)
    return answer


def test_a_raw_body_gives_the_engines_frames_as_npz(tmp_path: Path) -> None:
    (tmp_path / "temp").mkdir()
    answer = post(tmp_path / "temp", content=b"video", headers=MP4, url="/depth?name=colon.mp4")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/x-npz"
    assert 'filename="colon.npz"' in answer.headers["content-disposition"]
    (tmp_path / "r.npz").write_bytes(answer.content)
    clip = load_npz(tmp_path / "r.npz")
    np.testing.assert_array_equal(clip.depth[2], plane(2, (24, 32)).depth)
    np.testing.assert_array_equal(clip.world_from_camera[3], plane(3, (24, 32)).world_from_camera)
    assert clip.meta.name == "colon"
    assert {"decode", "receive", "queue", "work"} <= set(clip.meta.timings_s)


def test_multipart_gives_the_same_as_the_raw_body(tmp_path: Path) -> None:
    answer = post(
        tmp_path,
        files={"clip": ("../a/colon.mp4", b"video" * 1000, "video/mp4")},
        headers={"accept": "application/json"},
    )
    assert answer.status_code == 200
    assert answer.json()["meta"]["name"] == "colon"
    assert len(answer.json()["frames"]) == 4


def test_zip_holds_16_bit_pictures(tmp_path: Path) -> None:
    (tmp_path / "temp").mkdir()
    answer = post(tmp_path / "temp", content=b"video", headers={**MP4, "accept": "application/zip"})
    assert "depth/000003.png" in zipfile.ZipFile(io.BytesIO(answer.content)).namelist()
    (tmp_path / "r.zip").write_bytes(answer.content)
    np.testing.assert_allclose(load_zip(tmp_path / "r.zip").depth[1], plane(1, (24, 32)).depth, atol=2 / 32768)


def test_json_summary_has_cameras_and_depth_ranges(tmp_path: Path) -> None:
    summary = post(tmp_path, content=b"video", headers={**MP4, "accept": "application/json"}).json()
    assert summary["size"] == [24, 32]
    frame = summary["frames"][3]
    assert frame["world_from_camera"][0][3] == pytest.approx(0.3)
    assert frame["valid_fraction"] == pytest.approx(31 / 32)
    assert frame["depth_range"][1] == pytest.approx(1.5, abs=0.04)


def test_options_reach_the_engine_and_the_writer(tmp_path: Path) -> None:
    (tmp_path / "temp").mkdir()
    answer = post(tmp_path / "temp", content=b"v", headers=MP4, url="/depth?stride=2&depth=head&dtype=float16")
    (tmp_path / "r.npz").write_bytes(answer.content)
    clip = load_npz(tmp_path / "r.npz")
    assert (len(clip), clip.depth.dtype, clip.meta.depth) == (2, np.float16, "head")


@pytest.mark.parametrize(
    ("accept", "form"),
    [
        ("*/*", "application/x-npz"),
        ("application/*;q=0.5, application/zip", "application/zip"),
        ("application/json;q=0.9, application/zip;q=0.8", "application/json"),
        ("text/html, application/x-npz;q=0", None),
        ("image/png", None),
    ],
)
def test_the_accept_header_chooses_the_form(tmp_path: Path, accept: str, form: str | None) -> None:
    answer = post(tmp_path, content=b"video", headers={**MP4, "accept": accept})
    if form is None:
        assert answer.status_code == 406
        assert "application/x-npz" in answer.json()["detail"]
    else:
        assert answer.headers["content-type"] == form


async def chunks(total: int) -> AsyncIterator[bytes]:
    for _ in range(total // 1000):
        yield b"x" * 1000


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"content": b"", "headers": MP4}, 422, "empty (0 bytes)"),
        ({"content": NOT_A_CLIP, "headers": MP4}, 422, "not a video"),
        ({"content": b"v", "headers": {"content-type": "text/plain"}}, 415, "video/*"),
        ({"content": b"v"}, 415, "(none)"),
        ({"content": b"v", "headers": {"content-type": "multipart/form-data"}}, 400, "multipart"),
        ({"content": b"v", "headers": {"content-type": "multipart/form-data; boundary=x"}}, 400, "multipart"),
        ({"files": {"video": ("a.mp4", b"v")}}, 400, "'video'"),
        ({"files": [("clip", ("a.mp4", b"v")), ("clip", ("b.mp4", b"v"))]}, 400, "one clip"),
        ({"files": {"clip": ("a.mp4", b"")}}, 422, "empty"),
        ({"content": b"v", "headers": MP4, "url": "/depth?stride=0"}, 422, "stride"),
        ({"content": b"v", "headers": MP4, "url": "/depth?strid=2"}, 422, "strid"),
        ({"content": b"x" * 3000, "headers": MP4, "settings": {"max_upload_mb": 0.002}}, 413, "2097 bytes"),
        ({"content": chunks(5000), "headers": MP4, "settings": {"max_upload_mb": 0.002}}, 413, "2097 bytes"),
        ({"files": {"clip": ("a", b"x" * 3000)}, "settings": {"max_upload_mb": 0.002}}, 413, "2097 bytes"),
        ({"content": BREAKS, "headers": MP4}, 500, "request id"),
    ],
)
def test_what_cannot_be_served_is_a_problem_with_the_right_status(
    tmp_path: Path, request_: dict[str, Any], status: int, words: str
) -> None:
    answer = post(tmp_path, **request_)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["status"] == status
    assert words in problem["detail"]
    assert "secret" not in answer.text
    assert problem["request_id"] == answer.headers["x-request-id"]


def test_unknown_paths_and_methods_are_problems_too(tmp_path: Path) -> None:
    lost, wrong = get(tmp_path, "/nowhere"), get(tmp_path, "/depth")
    assert (lost.status_code, wrong.status_code) == (404, 405)
    assert wrong.headers["allow"] == "POST"
    assert lost.json()["request_id"] == lost.headers["x-request-id"]


def test_a_request_id_is_taken_over_only_when_it_is_a_plain_word(tmp_path: Path) -> None:
    assert get(tmp_path, "/healthz", headers={"x-request-id": "abc-1"}).headers["x-request-id"] == "abc-1"
    assert len(get(tmp_path, "/healthz", headers={"x-request-id": 'a"b c'}).headers["x-request-id"]) == 32


def test_bundle_states_the_model(tmp_path: Path) -> None:
    answer = get(tmp_path, "/bundle").json()
    assert (answer["digest"], answer["manifest"]["name"]) == ("f" * 64, "fake")


def test_readiness_waits_for_the_warm_up_and_health_does_not(tmp_path: Path) -> None:
    async def run() -> list[int]:
        app = create_app(FakeEngine(), ServiceSettings(temp=tmp_path))
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://t") as http:
            answers = [await http.get("/healthz"), await http.get("/readyz"), await http.post("/depth", content=b"v")]
            assert "retry-after" in answers[2].headers
            return [answer.status_code for answer in answers]

    assert asyncio.run(run()) == [200, 503, 503]


class Cold(FakeEngine):
    def warm_up(self) -> None:
        raise RuntimeError("no kernel for this node")


def test_a_failed_warm_up_is_told_by_readiness(tmp_path: Path) -> None:
    answer = talk(tmp_path, lambda http: http.get("/readyz"), Cold())
    assert (answer.status_code, "failed" in answer.json()["detail"]) == (503, True)


def test_the_queue_is_bounded_and_says_when_to_come_back(tmp_path: Path) -> None:
    async def conversation(http: httpx.AsyncClient) -> list[httpx.Response]:
        return await asyncio.gather(*(http.post("/depth", content=b"v", headers=MP4) for _ in range(6)))

    answers = talk(tmp_path, conversation, FakeEngine(delay_s=0.05), queue=2)
    statuses = sorted(answer.status_code for answer in answers)
    assert statuses == [200, 200, 200, 503, 503, 503]
    assert all(int(answer.headers["retry-after"]) >= 1 for answer in answers if answer.status_code == 503)


def test_one_client_cannot_take_every_place(tmp_path: Path) -> None:
    async def conversation(http: httpx.AsyncClient) -> list[httpx.Response]:
        return await asyncio.gather(*(http.post("/depth", content=b"v", headers=MP4) for _ in range(3)))

    answers = talk(tmp_path, conversation, FakeEngine(delay_s=0.05), clips_per_client=1)
    assert sorted(answer.status_code for answer in answers) == [200, 429, 429]


def test_inference_does_not_hold_up_the_other_routes(tmp_path: Path) -> None:
    async def conversation(http: httpx.AsyncClient) -> bool:
        work = asyncio.create_task(http.post("/depth", content=b"v", headers=MP4))
        await asyncio.sleep(0.05)
        await http.get("/healthz")
        answered_meanwhile = not work.done()
        await work
        return answered_meanwhile

    assert talk(tmp_path, conversation, FakeEngine(delay_s=0.1))


def test_a_clip_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    engine = FakeEngine(frames=1000, delay_s=0.02)
    answer = post(tmp_path, engine, {"work_timeout_s": 0.1}, content=b"v", headers=MP4)
    assert (answer.status_code, "larger stride" in answer.json()["detail"]) == (422, True)
    assert engine.runs[0].yielded < 100
    assert engine.runs[0].closed


async def trickle() -> AsyncIterator[bytes]:
    for _ in range(100):
        yield b"x"
        await asyncio.sleep(0.05)


def test_a_body_that_trickles_is_cut_at_the_deadline(tmp_path: Path) -> None:
    answer = post(tmp_path, content=trickle(), headers=MP4, settings={"receive_timeout_s": 0.2})
    assert (answer.status_code, "0.2 s" in answer.json()["detail"]) == (408, True)


def test_timings_are_in_the_server_timing_header(tmp_path: Path) -> None:
    header = post(tmp_path, content=b"v", headers=MP4).headers["server-timing"]
    assert "decode;dur=250.0" in header
    assert "work;dur=" in header


def test_the_description_is_complete_and_needs_no_other_host(tmp_path: Path) -> None:
    schema = get(tmp_path, "/openapi.json").json()
    text = json.dumps(schema)
    named = {part.split('"')[0] for part in text.split("#/components/schemas/")[1:]}
    assert named <= set(schema["components"]["schemas"])
    assert set(schema["paths"]) == {"/depth", "/healthz", "/readyz", "/bundle"}
    assert "multipart/form-data" in schema["paths"]["/depth"]["post"]["requestBody"]["content"]
    page = get(tmp_path, "/docs")
    assert "//" not in page.text.replace("<!doctype html>", "")
    for line in page.text.splitlines():
        if "docs/" in line:
            name = line.split("docs/")[1].split('"')[0]
            assert get(tmp_path, f"/docs/{name}").status_code == 200


def test_answers_carry_safety_headers(tmp_path: Path) -> None:
    headers = get(tmp_path, "/docs").headers
    assert headers["x-content-type-options"] == "nosniff"
    assert "default-src 'self'" in headers["content-security-policy"]


class FullDisk(FakeEngine):
    def run(self, *_: Any, **__: Any) -> Any:
        raise OSError(28, "No space left on device")


def test_a_full_disk_is_507(tmp_path: Path) -> None:
    assert post(tmp_path, FullDisk(), content=b"v", headers=MP4).status_code == 507


def test_the_log_has_one_line_a_request_without_content(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as lines:
        post(tmp_path, content=b"patient data", headers={**MP4, "x-request-id": "abc"})
    (line,) = [line for line in lines if line["event"] == "request"]
    assert (line["request_id"], line["status"], line["bytes_in"], line["frames"]) == ("abc", 200, 12, 4)
    assert "patient" not in str(lines)


def test_a_failure_is_logged_with_its_reason(tmp_path: Path) -> None:
    with structlog.testing.capture_logs() as lines:
        answer = post(tmp_path, content=BREAKS, headers=MP4)
    (failure,) = [line for line in lines if line["event"] == "request_failed"]
    assert failure["request_id"] == answer.json()["request_id"]
    assert "secret inner detail" in str(failure["exc_info"])


def test_a_request_that_the_service_cancels_is_told_to_come_back(tmp_path: Path) -> None:
    """What uvicorn does to requests that outlast the time to drain."""

    async def run() -> tuple[list[dict[str, Any]], FakeEngine]:
        engine = FakeEngine(frames=1000, delay_s=0.02)
        app = create_app(engine, ServiceSettings(temp=tmp_path))
        sent: list[dict[str, Any]] = []
        body = iter([{"type": "http.request", "body": b"clip", "more_body": False}])

        async def receive() -> dict[str, Any]:
            if (message := next(body, None)) is not None:
                return message
            await asyncio.sleep(60)
            raise AssertionError

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {
            "type": "http", "method": "POST", "path": "/depth", "query_string": b"", "client": ("t", 1),
            "headers": [(b"content-type", b"video/mp4"), (b"content-length", b"4")],
        }  # fmt: skip
        async with app.router.lifespan_context(app):
            while app.state.service.state == "starting":
                await asyncio.sleep(0.001)
            task = asyncio.create_task(app(scope, receive, send))
            while not engine.runs:
                await asyncio.sleep(0.01)
            task.cancel()
            await asyncio.wait({task})
            assert task.cancelled()
        return sent, engine

    sent, engine = asyncio.run(run())
    assert sent[0]["status"] == 503
    assert json.loads(sent[1]["body"])["type"].endswith(":stopping")
    assert engine.runs[0].closed
    assert list(tmp_path.iterdir()) == []

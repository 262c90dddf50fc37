"""The service on a real socket: limits while bytes arrive, clients that leave, what stays behind."""

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from fake_engine import FakeEngine
from live_server import live_server

from bathyscope_serve.app import create_app
from bathyscope_serve.settings import ServiceSettings


def wait_until(condition: Callable[[], bool], timeout_s: float = 10.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def files_below(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def head(length: int | str, path: str = "/depth") -> bytes:
    body = f"Content-Length: {length}" if isinstance(length, int) else "Transfer-Encoding: chunked"
    return f"POST {path} HTTP/1.1\r\nHost: t\r\nContent-Type: video/mp4\r\n{body}\r\n\r\n".encode()


def read_all(connection: socket.socket) -> bytes:
    answer = b""
    while block := connection.recv(65536):
        answer += block
    return answer


def test_a_client_that_leaves_stops_the_work_and_leaves_nothing_behind(tmp_path: Path) -> None:
    engine = FakeEngine(frames=10_000, delay_s=0.01)
    with live_server(create_app(engine, ServiceSettings(temp=tmp_path))) as (host, port):
        with socket.create_connection((host, port)) as connection:
            connection.sendall(head(4) + b"clip")
            assert wait_until(lambda: bool(engine.runs) and engine.runs[0].yielded > 2)
            assert files_below(tmp_path)
        assert wait_until(lambda: engine.runs[0].closed)
        assert engine.runs[0].yielded < 5000
        assert wait_until(lambda: not files_below(tmp_path))
        assert httpx.get(f"http://{host}:{port}/readyz").status_code == 200


def test_a_client_that_leaves_while_sending_leaves_nothing_behind(tmp_path: Path) -> None:
    engine = FakeEngine()
    with live_server(create_app(engine, ServiceSettings(temp=tmp_path))) as (host, port):
        with socket.create_connection((host, port)) as connection:
            connection.sendall(head(10 << 20) + bytes(3 << 20))
            assert wait_until(lambda: bool(files_below(tmp_path)))
        assert wait_until(lambda: not files_below(tmp_path))
        assert not engine.runs


def test_an_oversized_upload_is_refused_before_it_is_read_and_the_client_can_read_why(tmp_path: Path) -> None:
    settings = ServiceSettings(temp=tmp_path, max_upload_mb=1)
    with (
        live_server(create_app(FakeEngine(), settings)) as (host, port),
        socket.create_connection((host, port)) as line,
    ):
        line.sendall(head(50 << 20))
        answer = read_all(line)
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b"body-too-large" in answer
    assert b"connection: close" in answer.lower()


def test_a_chunked_upload_is_cut_at_the_limit(tmp_path: Path) -> None:
    def endless() -> Iterator[bytes]:
        while True:
            yield bytes(1 << 16)

    settings = ServiceSettings(temp=tmp_path, max_upload_mb=1)
    with live_server(create_app(FakeEngine(), settings)) as (host, port):
        try:
            answer = httpx.post(f"http://{host}:{port}/depth", content=endless(), headers={"content-type": "video/mp4"})
            assert answer.status_code == 413
        except httpx.WriteError:
            pytest.fail("the connection was reset before the refusal could be read")


def test_a_body_that_stops_arriving_is_cut_at_the_deadline(tmp_path: Path) -> None:
    settings = ServiceSettings(temp=tmp_path, receive_timeout_s=0.3)
    with (
        live_server(create_app(FakeEngine(), settings)) as (host, port),
        socket.create_connection((host, port)) as line,
    ):
        began = time.monotonic()
        line.sendall(head("chunked") + b"4\r\nclip\r\n")
        answer = read_all(line)
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert time.monotonic() - began < 5


def test_a_head_that_trickles_is_cut_at_the_deadline(tmp_path: Path) -> None:
    app = create_app(FakeEngine(), ServiceSettings(temp=tmp_path))
    with live_server(app, header_timeout_s=0.3) as (host, port), socket.create_connection((host, port)) as line:
        line.settimeout(5)
        line.sendall(b"GET /healthz HTTP/1.1\r\nHost:")
        assert read_all(line) == b""


def test_a_client_that_does_not_read_its_answer_is_given_up(tmp_path: Path) -> None:
    engine = FakeEngine(frames=40, size=(400, 400))
    app = create_app(engine, ServiceSettings(temp=tmp_path, send_timeout_s=0.3))
    with live_server(app) as (host, port), socket.socket() as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect((host, port))
        line.sendall(head(4) + b"clip")
        assert wait_until(lambda: bool(engine.runs) and engine.runs[0].closed)
        assert wait_until(lambda: not files_below(tmp_path)), "though the connection is still open"
        with httpx.Client(base_url=f"http://{host}:{port}") as other:
            assert other.get("/readyz").status_code == 200


def test_what_is_no_http_is_a_problem_with_a_request_id_too(tmp_path: Path) -> None:
    app = create_app(FakeEngine(), ServiceSettings(temp=tmp_path))
    with live_server(app) as (host, port), socket.create_connection((host, port)) as line:
        line.sendall(b"GET / HTTP/1.1\r\nno colon\r\n\r\n")
        top, body = read_all(line).split(b"\r\n\r\n")
    assert top.startswith(b"HTTP/1.1 400 ")
    assert f"x-request-id: {json.loads(body)['request_id']}".encode() in top


def test_the_deadline_of_the_head_spares_slow_estimates_and_idle_connections(tmp_path: Path) -> None:
    app = create_app(FakeEngine(delay_s=0.15), ServiceSettings(temp=tmp_path))
    with live_server(app, header_timeout_s=0.3) as (host, port), httpx.Client(base_url=f"http://{host}:{port}") as http:
        for _ in range(2):
            assert http.post("/depth", content=b"v", headers={"content-type": "video/mp4"}).status_code == 200
            time.sleep(0.4)


def test_an_early_refusal_does_not_read_the_rest_without_end(tmp_path: Path) -> None:
    app = create_app(FakeEngine(), ServiceSettings(temp=tmp_path))
    with live_server(app) as (host, port), socket.create_connection((host, port)) as line:
        line.sendall(head("chunked", "/nowhere") + b"4\r\nclip\r\n")
        assert read_all(line).startswith(b"HTTP/1.1 404 ")


def resident_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads memory from /proc")
@pytest.mark.parametrize("multipart", [False, True], ids=["raw", "multipart"])
def test_memory_does_not_grow_with_the_upload(tmp_path: Path, multipart: bool) -> None:
    def body(megabytes: int) -> Iterator[bytes]:
        if multipart:
            yield b'--x\r\nContent-Disposition: form-data; name="clip"; filename="a.mp4"\r\n\r\n'
        for _ in range(megabytes * 16):
            yield block
        if multipart:
            yield b"\r\n--x--\r\n"

    block = np.random.default_rng(0).bytes(1 << 16)
    headers = {"content-type": "multipart/form-data; boundary=x" if multipart else "video/mp4"}
    with live_server(create_app(FakeEngine(), ServiceSettings(temp=tmp_path))) as (host, port):
        url = f"http://{host}:{port}/depth"
        assert httpx.post(url, content=body(2), headers=headers, timeout=60).status_code == 200
        before = resident_mb()
        peak = [before]
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.005):
                peak[0] = max(peak[0], resident_mb())

        watcher = threading.Thread(target=watch)
        watcher.start()
        assert httpx.post(url, content=body(100), headers=headers, timeout=60).status_code == 200
        done.set()
        watcher.join()
    assert peak[0] - before < 16

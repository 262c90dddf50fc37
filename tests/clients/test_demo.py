"""The demo starts a service, waits for it, and always stops it; shown with a stand-in service."""

from __future__ import annotations

import sys
from pathlib import Path

import httpx
import pytest

from bathyscope.errors import ServiceError
from bathyscope_client.demo import running_service

READY_AT_THE_THIRD_ASKING = """
import json, os, sys
from http.server import BaseHTTPRequestHandler, HTTPServer
asked = 0
class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        global asked
        asked += 1
        self.send_response(200 if asked >= 3 else 503)
        self.end_headers()
        self.wfile.write(str(asked).encode())
    def log_message(self, *_):
        print("not json", file=sys.stderr)
server = HTTPServer(("127.0.0.1", 0), Handler)
print(json.dumps({"event": "listening", "url": f"http://127.0.0.1:{server.server_port}"}), file=sys.stderr, flush=True)
server.serve_forever()
"""


def program(tmp_path: Path, code: str) -> tuple[str, ...]:
    script = tmp_path / "service.py"
    script.write_text(code)
    return sys.executable, str(script)


def test_the_service_is_handed_out_when_it_is_ready_and_gone_afterwards(tmp_path: Path) -> None:
    command = program(tmp_path, READY_AT_THE_THIRD_ASKING)
    with running_service(tmp_path / "log", 30.0, command) as url:
        assert httpx.get(url, trust_env=False).text == "4"
    with pytest.raises(httpx.TransportError):
        httpx.get(url, trust_env=False)


def test_the_service_is_stopped_when_the_work_fails(tmp_path: Path) -> None:
    with (
        pytest.raises(ZeroDivisionError),
        running_service(tmp_path / "log", 30.0, program(tmp_path, READY_AT_THE_THIRD_ASKING)) as url,
    ):
        raise ZeroDivisionError
    with pytest.raises(httpx.TransportError):
        httpx.get(url, trust_env=False)


def test_a_service_that_ends_is_quoted(tmp_path: Path) -> None:
    command = program(tmp_path, "import sys; sys.exit('bundle.json: no such bundle')")
    with (
        pytest.raises(ServiceError, match=r"ended with code 1 .*: bundle\.json: no such bundle"),
        running_service(tmp_path / "log", 30.0, command),
    ):
        pytest.fail("it was never ready")


def test_a_service_that_never_gets_ready_is_given_up(tmp_path: Path) -> None:
    command = program(tmp_path, "import time; print('loading', flush=True); time.sleep(60)")
    with (
        pytest.raises(ServiceError, match=r"not ready in time.*loading"),
        running_service(tmp_path / "log", 1.0, command),
    ):
        pytest.fail("it was never ready")

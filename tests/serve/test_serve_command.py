"""``bathyscope serve`` as a process of its own, with a bundle from disk; and the same clip without it."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from clips_on_disk import write_images, write_video
from made_bundle import write_bundle

from bathyscope.result_files import load_npz
from bathyscope_client import DepthClient

COMMAND = (sys.executable, "-m", "bathyscope")


class Process:
    """A running ``bathyscope serve``."""

    def __init__(self, bundle: Path, log: Path, *options: str) -> None:
        self.log = log
        with log.open("wb") as stream:
            command = [*COMMAND, "serve", "--bundle", str(bundle), "--port", "0", "--temp", str(log.parent), *options]
            self.process = subprocess.Popen(command, stderr=stream)
        self.url = self._wait_for("listening")["url"]
        self._wait_for("ready")

    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.log.read_text().splitlines() if line.startswith("{")]

    def _wait_for(self, event: str) -> dict[str, Any]:
        end = time.monotonic() + 300
        while time.monotonic() < end:
            assert self.process.poll() is None, self.log.read_text()
            if found := [line for line in self.lines() if line["event"] == event]:
                return found[0]
            time.sleep(0.05)
        raise AssertionError(f"no {event!r} in time: {self.log.read_text()}")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bundle(tmp_path_factory.mktemp("bundle")).folder


@pytest.fixture
def service(bundle: Path, tmp_path: Path) -> Iterator[Process]:
    (tmp_path / "temp").mkdir()
    service = Process(bundle, tmp_path / "temp" / "log")
    yield service
    service.process.kill()
    service.process.wait()


@pytest.mark.slow
def test_service_and_command_give_the_same_depth_and_sigterm_ends_the_service_tidily(
    service: Process, bundle: Path, tmp_path: Path
) -> None:
    video = write_video(tmp_path / "colon.mp4", 6, (48, 64))
    with DepthClient(service.url) as client:
        served = client.depth(video)
        assert client.bundle().digest == served.meta.bundle.digest  # type: ignore[union-attr]
    arguments = [str(video), "-o", str(tmp_path / "out"), "--bundle", str(bundle), "--json"]
    done = subprocess.run([*COMMAND, "depth", *arguments], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    local = load_npz(json.loads(done.stdout)[0]["outputs"]["depth"])
    np.testing.assert_array_equal(local.depth, served.depth)
    np.testing.assert_array_equal(local.world_from_camera, served.world_from_camera)
    assert local.meta.bundle == served.meta.bundle

    long = write_images(tmp_path / "long", 60, (200, 300))
    answers: list[int] = []

    def ask() -> None:
        with DepthClient(service.url) as client:
            answers.append(len(client.depth(long)))

    asking = threading.Thread(target=ask)
    asking.start()
    while not [path for path in (tmp_path / "temp").rglob("*") if path.name == "valid"]:
        time.sleep(0.02)
        assert asking.is_alive()
    service.process.send_signal(signal.SIGTERM)
    asking.join(60)
    service.process.wait(60)
    assert answers == [60], "an accepted clip is finished"
    assert {path.name for path in (tmp_path / "temp").iterdir()} == {"log"}
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{service.url}/healthz", trust_env=False)

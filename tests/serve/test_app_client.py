"""Service and client together, over a real socket."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clips_on_disk import write_images, write_video
from fake_engine import NOT_A_CLIP, FakeEngine, plane
from live_server import live_server
from typer.testing import CliRunner

from bathyscope.engines import DepthOptions
from bathyscope.errors import ServiceError
from bathyscope_client import DepthClient, cli
from bathyscope_serve.app import create_app
from bathyscope_serve.settings import ServiceSettings


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    folder = tmp_path / "temp"
    folder.mkdir()
    with live_server(create_app(FakeEngine(), ServiceSettings(temp=folder))) as (host, port):
        yield f"http://{host}:{port}"
        (root,) = folder.iterdir()
        deadline = time.monotonic() + 10
        while list(root.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.01)  # a request's folder goes after its answer has been sent
        assert list(root.iterdir()) == []


def test_depth_goes_round(url: str, tmp_path: Path) -> None:
    with DepthClient(url) as client:
        assert client.ready()
        assert client.bundle().manifest.name == "fake"
        clip = client.depth(write_video(tmp_path / "colon.mp4"), DepthOptions(stride=2))
    assert clip.meta.name == "colon"
    np.testing.assert_array_equal(clip.depth[1], plane(2, (24, 32)).depth)


def test_a_folder_of_images_goes_as_one_clip(url: str, tmp_path: Path) -> None:
    with DepthClient(url) as client:
        assert client.depth(write_images(tmp_path / "polyp")).meta.name == "polyp"


def test_a_refusal_names_the_request(url: str, tmp_path: Path) -> None:
    (tmp_path / "colon.mp4").write_bytes(NOT_A_CLIP)
    with DepthClient(url) as client, pytest.raises(ServiceError, match="colon: not a video") as caught:
        client.depth(tmp_path / "colon.mp4")
    assert caught.value.status == 422
    assert len(caught.value.request_id or "") == 32


def test_an_upload_over_the_limit_is_told_to_the_client(tmp_path: Path) -> None:
    settings = ServiceSettings(temp=tmp_path, max_upload_mb=1)
    (tmp_path / "big.mp4").write_bytes(bytes(8 << 20))
    app = create_app(FakeEngine(), settings)
    with live_server(app) as (host, port), DepthClient(f"http://{host}:{port}") as client:  # noqa: SIM117 - two lines
        with pytest.raises(ServiceError, match="1048576 bytes") as caught:
            client.depth(tmp_path / "big.mp4")
    assert caught.value.status == 413


def test_the_command_makes_the_same_files_through_the_service(url: str, tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    write_video(folder / "a.mp4")
    (folder / "b.mp4").write_bytes(NOT_A_CLIP)
    arguments = [str(folder), "-o", str(tmp_path / "out"), "--url", url, "--json"]
    outcome = CliRunner().invoke(cli.app, arguments)
    assert outcome.exit_code == 1
    reports = json.loads(outcome.stdout)
    assert [report["status"] for report in reports] == ["done", "failed"]
    assert reports[1]["request_id"] in outcome.stderr
    assert all(Path(path).is_file() for path in reports[0]["outputs"].values())

"""Batches: what is done is skipped, what fails is named, what is half made disappears."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from clips_on_disk import write_images, write_video
from fake_engine import NOT_A_CLIP, FakeEngine
from typer.testing import CliRunner

from bathyscope.errors import BundleError, ClipError
from bathyscope_client import cli
from bathyscope_client.batch import BatchSettings, ClipReport, run_batch
from bathyscope_client.clips import find_clips
from bathyscope_client.outputs import SUFFIXES
from bathyscope_client.runners import EngineRunner


def quiet(_: Any) -> Any:
    return lambda stage, done, total: None


def batch(source: Path, out: Path, engine: FakeEngine, again: bool = False, **settings: Any) -> list[ClipReport]:
    runner = EngineRunner(engine)
    return list(run_batch(find_clips(source), out, runner, BatchSettings(**settings), progress=quiet, again=again))


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    for name in ("a.mp4", "b.mp4"):
        write_video(folder / name)
    return folder


def statuses(reports: list[ClipReport]) -> list[str]:
    return [report.status for report in reports]


def test_every_clip_gets_every_file_and_nothing_else_stays(videos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    reports = batch(videos, out, FakeEngine())
    assert statuses(reports) == ["done", "done"]
    expected = {f"{name}{suffix}" for name in "ab" for suffix in (*SUFFIXES.values(), "_done.json")}
    assert {path.name for path in out.iterdir()} == expected
    assert reports[0].meta is not None
    assert reports[0].meta.name == "a"


def test_a_second_run_does_no_work(videos: Path, tmp_path: Path) -> None:
    out, engine = tmp_path / "out", FakeEngine()
    batch(videos, out, engine)
    assert statuses(batch(videos, out, engine)) == ["skipped", "skipped"]
    assert len(engine.runs) == 2


@pytest.mark.parametrize("change", ["touched", "settings", "model", "lost file", "damaged marker", "asked for"])
def test_what_changed_is_made_again(videos: Path, tmp_path: Path, change: str) -> None:
    out, engine = tmp_path / "out", FakeEngine()
    batch(videos, out, engine)
    settings: dict[str, Any] = {}
    match change:
        case "touched":
            os.utime(videos / "a.mp4", (1, 1))
        case "settings":
            settings = {"precision": "float16"}
        case "model":
            object.__setattr__(engine.bundle, "digest", "e" * 64)
        case "lost file":
            (out / "a_cloud.ply").unlink()
        case "damaged marker":
            (out / "a_done.json").write_text("{")
    reports = batch(videos, out, engine, again=change == "asked for", **settings)
    assert reports[0].status == "done"


def test_a_clip_that_fails_is_named_and_the_others_are_made(videos: Path, tmp_path: Path) -> None:
    (videos / "a.mp4").write_bytes(NOT_A_CLIP)
    out = tmp_path / "out"
    reports = batch(videos, out, FakeEngine())
    assert statuses(reports) == ["failed", "done"]
    assert "a: not a video" in (reports[0].error or "")
    assert not list(out.glob("a*")) + list(out.glob(".*"))


def test_a_failure_on_the_way_leaves_the_files_of_the_run_before(videos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    batch(videos, out, FakeEngine())
    before = (out / "a.npz").read_bytes()
    (videos / "a.mp4").write_bytes(NOT_A_CLIP)
    assert batch(videos, out, FakeEngine())[0].status == "failed"
    assert (out / "a.npz").read_bytes() == before
    assert not (out / "a_done.json").exists(), "the old files are not this source's"


def test_leavings_of_a_killed_run_are_no_obstacle(videos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / ".a.part").mkdir(parents=True)
    (out / ".a.part" / "a.npz").write_bytes(b"half")
    assert statuses(batch(videos, out, FakeEngine())) == ["done", "done"]
    assert not (out / ".a.part").exists()


def test_a_folder_of_images_is_one_clip(tmp_path: Path) -> None:
    reports = batch(write_images(tmp_path / "polyp"), tmp_path / "out", FakeEngine())
    assert [(report.name, report.status) for report in reports] == [("polyp", "done")]


def test_videos_that_share_a_stem_get_different_names(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.mov", "b10.mp4", "b9.mp4", ".hidden.mp4", "a.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [clip.name for clip in find_clips(tmp_path)] == ["a.mov", "a.mp4", "b9", "b10"]


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_nothing_to_do_is_an_error(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ClipError, match=name):
        find_clips(tmp_path / name)


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> Any:
    monkeypatch.delenv("BATHYSCOPE_URL", raising=False)
    monkeypatch.setattr(EngineRunner, "load", classmethod(lambda cls, _: cls(FakeEngine())))
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def test_command_tells_where_the_files_are(videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = command(monkeypatch, videos / "a.mp4", "-o", tmp_path / "out")
    assert (outcome.exit_code, outcome.stderr) == (0, "")
    assert str(tmp_path / "out" / "a.npz") in outcome.stdout
    assert "differs from that of followed points by 12.5% (200 a frame, in 3 frames)" in outcome.stdout


def test_command_names_failures_and_exits_with_1(videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (videos / "a.mp4").write_bytes(NOT_A_CLIP)
    outcome = command(monkeypatch, videos, "-o", tmp_path / "out", "--json")
    assert outcome.exit_code == 1
    assert "a: failed: a: not a video" in outcome.stderr
    reports = json.loads(outcome.stdout)
    assert [report["status"] for report in reports] == ["failed", "done"]
    assert Path(reports[1]["outputs"]["cloud"]).is_file()


@pytest.mark.parametrize(
    "arguments", [["nowhere.mp4"], [], ["x", "--stride", "0"], ["x", "--depth", "guess"], ["x", "--colour", "red"]]
)
def test_command_exits_with_2_for_wrong_usage(monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    assert command(monkeypatch, *arguments).exit_code == 2


def test_command_refuses_what_would_be_silently_ignored_or_taken_for_a_clip(
    videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = command(monkeypatch, videos, "-o", tmp_path / "out", "--url", "http://t", "--bundle", tmp_path)
    inside = command(monkeypatch, videos, "-o", videos)
    assert (both.exit_code, inside.exit_code) == (2, 2)
    assert "either --url or --bundle" in both.stderr
    assert "another --out" in inside.stderr


def test_command_exits_with_2_for_a_missing_bundle(videos: Path, tmp_path: Path) -> None:
    arguments = [str(videos), "-o", str(tmp_path / "out"), "--bundle", str(tmp_path / "no-bundle")]
    outcome = CliRunner(env={"BATHYSCOPE_URL": ""}).invoke(cli.app, arguments)
    assert outcome.exit_code == 2
    assert "no-bundle" in outcome.stderr


def test_command_exits_with_1_when_the_service_is_not_there(videos: Path, tmp_path: Path) -> None:
    arguments = [str(videos), "-o", str(tmp_path / "out"), "--url", "http://127.0.0.1:9"]
    outcome = CliRunner().invoke(cli.app, arguments)
    assert outcome.exit_code == 1
    assert "cannot be reached" in outcome.stderr


def test_bundle_error_is_what_a_missing_bundle_raises(tmp_path: Path) -> None:
    pytest.importorskip("bathyscope_serve.engine", exc_type=ImportError)
    with pytest.raises(BundleError):
        EngineRunner.load(tmp_path / "no-bundle")

"""The engine with networks that give one map a frame and no cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_bundle import write_video_bundle
from numpy.typing import NDArray

from bathyscope.bundle import Bundle
from bathyscope.clip import Clip
from bathyscope.engines import DepthOptions
from bathyscope.errors import BundleError, GeometryError, SettingsError
from bathyscope.result_files import load_npz
from bathyscope.result_zip import load_zip
from bathyscope_serve.engine import DepthEngine
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.estimate import Estimate, Order
from bathyscope_serve.video_session import input_size

RESIZE = {"least": [28, 28], "lower_long": True}
WINDOWS = {"length": 8, "key_places": [0, 3, 6, 7], "blend": 2, "fit": "references"}
DISPARITY = {"quantity": "disparity", "scale": "affine", "resize": RESIZE, "windows": WINDOWS}
METRES = {"quantity": "depth", "scale": "metric", "unit": "m", "resize": RESIZE, "windows": WINDOWS | {"fit": "none"}}
SINGLE = {
    "quantity": "depth",
    "scale": "relative",
    "resize": {"least": [28, 42], "back": "centres"},
    "windows": None,
    "depth_range": {"nearest": 0.1, "farthest": 10.0},
}


def slopes(count: int, size: tuple[int, int] = (40, 60)) -> Clip:
    """Grey ramps that grow brighter from frame to frame."""
    ramp = np.linspace(40, 120, size[1])[None, :, None] + np.zeros((*size, 3))
    frames = np.stack([ramp + 2 * t for t in range(count)]).round().astype(np.uint8)
    return Clip(frames, np.arange(count) / 25.0, "ramps")


def engine(folder: Path, video: dict[str, Any], settings: EngineSettings | None = None) -> DepthEngine:
    windows = video["windows"]
    shape = (8, 4) if windows else (1, 0)
    return DepthEngine(write_video_bundle(folder, video, *shape), settings or EngineSettings(threads=1))


def brightness(clip: Clip) -> NDArray[np.float64]:
    return clip.frames.mean(3) / 255


@pytest.mark.parametrize("count", [1, 8, 9, 21])
def test_disparity_comes_back_as_disparity_and_nothing_else(tmp_path: Path, count: int) -> None:
    clip = slopes(count)
    result = engine(tmp_path, DISPARITY).depth_of(clip)
    assert result.meta.outputs == ("disparity",)
    assert (result.meta.scale, result.meta.depth) == ("affine", "head")
    assert (result.confidence, result.world_from_camera, result.intrinsics) == (None, None, None)
    assert len(result) == count
    np.testing.assert_allclose(result.depth, brightness(clip), atol=0.015)  # down to 28 rows and back
    assert result.valid.all()
    assert set(result.segment) == {0}


def test_metres_come_back_as_millimetres(tmp_path: Path) -> None:
    clip = slopes(10)
    result = engine(tmp_path, METRES).depth_of(clip)
    assert (result.meta.outputs, result.meta.scale) == (("depth",), "mm")
    np.testing.assert_allclose(result.depth, 1000 * brightness(clip), atol=15)


def test_a_network_without_windows_is_run_frame_by_frame(tmp_path: Path) -> None:
    clip = slopes(3)
    result = engine(tmp_path, SINGLE).depth_of(clip)
    expected = 1 / (0.1 + 9.9 * brightness(clip))
    np.testing.assert_allclose(result.depth, expected, rtol=0.04)
    assert (result.meta.outputs, result.meta.scale) == (("depth",), "relative")


def test_a_cut_begins_a_segment_with_windows_of_its_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first = np.tile(rng.integers(150, 255, (1, 40, 60, 3)), (10, 1, 1, 1)) * np.array([1, 0.2, 0.2])
    second = np.tile(rng.integers(80, 255, (1, 40, 60, 3)), (11, 1, 1, 1)) * np.array([0.2, 0.2, 1])
    clip = Clip(np.concatenate([first, second]).astype(np.uint8), np.arange(21) / 25.0)
    result = engine(tmp_path, DISPARITY).depth_of(clip)
    assert result.segment.tolist() == [0] * 10 + [1] * 11
    assert "a cut at frame 10: what follows has a scale of its own" in result.meta.warnings
    for t in (9, 10, 20):
        assert result.depth[t].mean() == pytest.approx(brightness(clip)[t].mean(), abs=0.01)


def test_values_count_only_inside_the_field_of_view(tmp_path: Path) -> None:
    clip = slopes(9, (80, 100))
    y, x = np.ogrid[:80, :100]
    outside = (x - 50) ** 2 + (y - 40) ** 2 > 36**2
    frames = np.where(outside[None, ..., None], 0, clip.frames).astype(np.uint8)
    result = engine(tmp_path, DISPARITY).depth_of(Clip(frames, clip.timestamps_s))
    assert not result.valid[:, outside].any()
    assert result.valid.mean() > 0.4
    assert (result.depth[~result.valid] == 0).all()


@pytest.mark.parametrize("form", ["npz", "zip", "json"])
def test_the_service_answers_without_cameras_in_every_form(tmp_path: Path, form: Any) -> None:
    clip = slopes(9)
    made = engine(tmp_path / "bundle", DISPARITY)
    order = Order(clip, tmp_path, "ramps", DepthOptions(), form, "float32", 0.0)  # type: ignore[arg-type]
    outcome = Estimate(made, order, timeout_s=60).run()
    assert outcome.meta.outputs == ("disparity",)
    if form == "json":
        assert outcome.summary is not None
        said = json.loads(outcome.summary.model_dump_json())["frames"]
        assert [frame["world_from_camera"] for frame in said] == [None] * 9
        return
    assert outcome.path is not None
    found = load_npz(outcome.path) if form == "npz" else load_zip(outcome.path)
    assert found.world_from_camera is None
    np.testing.assert_allclose(found.depth, brightness(clip), atol=0.015)


def test_rendered_depth_cannot_be_accumulated_where_nothing_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="made video renders nothing that could be accumulated"):
        engine(tmp_path, DISPARITY).run(slopes(2), DepthOptions(depth="accumulated"))


def test_known_intrinsics_are_of_no_use_without_cameras(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="made video has no cameras"):
        engine(tmp_path, DISPARITY).run(slopes(2), DepthOptions(intrinsics="50,50,30,20"))


def test_a_video_network_has_no_scene(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="made video is a video network: it has no scene"):
        engine(tmp_path, DISPARITY).scene(slopes(2))


def test_warming_up_takes_two_small_frames(tmp_path: Path) -> None:
    seen: list[tuple[int, ...]] = []

    class Watched:
        def values(self, images: NDArray[np.float32], checkpoint: object = None) -> NDArray[np.float32]:
            seen.append(images.shape)
            return images[:, 0]

    made = engine(tmp_path, DISPARITY)
    made.model = Watched()  # type: ignore[assignment]
    made.warm_up()
    assert seen == [(2, 3, 56, 56)]


def test_windows_of_a_video_network_cannot_be_changed(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="made video is a video network: window cannot be changed"):
        engine(tmp_path, DISPARITY, EngineSettings(window=16))


def test_values_below_zero_are_an_error(tmp_path: Path) -> None:
    class Negative:
        def values(self, images: NDArray[np.float32], checkpoint: object) -> NDArray[np.float32]:
            raise GeometryError("3 of the network's values are negative")

    made = engine(tmp_path, DISPARITY)
    made.model = Negative()  # type: ignore[assignment]
    with pytest.raises(GeometryError, match="negative"):
        made.depth_of(slopes(2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "scene"}, "a scene network must have the field 'scene'"),
        ({"input": {"patch": 14, "pixels": 1000, "window": 9, "overlap": 4}}, "input says windows of 9 frames"),
        ({"video": DISPARITY | {"scale": "metric"}}, "metric values, and only they, have a unit"),
    ],
)
def test_a_manifest_that_contradicts_itself_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write_video_bundle(tmp_path / "made", DISPARITY, 8, 4)
    path = tmp_path / "made" / "bundle.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(BundleError, match=message):
        Bundle.open(tmp_path / "made")


@pytest.mark.parametrize(
    ("frame", "expected"),
    [((40, 60), (28, 42)), ((60, 40), (42, 28)), ((100, 400), (14, 56))],
    ids=["wide", "tall", "very long"],
)
def test_inputs_keep_their_aspect(tmp_path: Path, frame: tuple[int, int], expected: tuple[int, int]) -> None:
    resize = engine(tmp_path, DISPARITY).bundle.manifest.video
    assert resize is not None
    assert input_size(frame, resize.resize, 14) == expected

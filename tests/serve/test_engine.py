"""The engine on a scene that is known in closed form: windows come back in worlds and scales of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_model import SPEC, AnalyticModel, focal_lengths, grey_clip, plane_depth, pose
from fake_engine import fake_bundle

from bathyscope.bundle import Bundle
from bathyscope.camera import rotation_angle
from bathyscope.clip import Clip
from bathyscope.engines import DepthOptions, engine_factory
from bathyscope.errors import ClipError, GeometryError
from bathyscope.result import ClipDepth
from bathyscope.scene import decode_cameras, with_focal
from bathyscope_serve.engine import DepthEngine
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.session import StoppedError

HEAD = DepthOptions(depth="head")
MODEL_SIZE = (42, 56)


def analytic_engine(window: int = 6, overlap: int = 2) -> tuple[DepthEngine, AnalyticModel]:
    bundle = fake_bundle()
    manifest = bundle.manifest.model_copy(update={"scene": SPEC})
    model = AnalyticModel()
    settings = EngineSettings(window=window, overlap=overlap, pixels=MODEL_SIZE[0] * MODEL_SIZE[1])
    return DepthEngine(Bundle(bundle.folder, manifest, bundle.digest), settings, model=model), model


def source_intrinsics(size: tuple[int, int]) -> np.ndarray:
    fx, fy = focal_lengths(size)
    return np.array([[fx, 0, size[1] / 2], [0, fy, size[0] / 2], [0, 0, 1]])


def assert_is_the_plane(result: ClipDepth, first: int = 0, tolerance: float = 2e-3) -> None:
    """Depth, cameras and intrinsics are the true ones, up to the scale of the first window."""
    k = source_intrinsics(result.size)
    np.testing.assert_allclose(result.intrinsics, np.broadcast_to(k, result.intrinsics.shape), rtol=1e-5)
    inverse = np.linalg.inv(pose(first))
    scale = np.median(result.depth[0] / plane_depth(first, k, result.size))
    for t in range(len(result)):
        depth = scale * plane_depth(first + t, k, result.size)
        error = np.abs(result.depth[t] / depth - 1)[result.valid[t]]
        assert np.quantile(error, 0.95) < tolerance, f"frame {t}"
        truth = inverse @ pose(first + t)
        found = result.world_from_camera[t]
        assert rotation_angle(found[:3, :3] @ truth[:3, :3].T) < 1e-3
        np.testing.assert_allclose(found[:3, 3], scale * truth[:3, 3], atol=2e-3 * scale)


@pytest.mark.parametrize("frames", [1, 2, 5, 6, 7, 9, 10, 23])
def test_windows_become_one_world_of_one_scale(frames: int) -> None:
    engine, model = analytic_engine()
    result = engine.depth_of(grey_clip(frames), HEAD)
    assert len(result) == frames
    assert set(result.segment) == {0}
    assert result.meta.warnings == ()
    assert_is_the_plane(result)
    assert all(len(window) == 6 for window in model.windows) or frames < 6


def test_rendered_depth_is_the_plane_too() -> None:
    engine, _ = analytic_engine()
    result = engine.depth_of(grey_clip(9))
    assert result.meta.depth == "rendered"
    assert result.valid.all()
    assert_is_the_plane(result, tolerance=0.02)


def test_known_intrinsics_reach_the_network_in_its_pixels_and_come_back_as_given() -> None:
    """The picture of 90x120 is 42x56 for the network: both focal lengths shrink by 7 / 15."""
    engine, model = analytic_engine()
    fx, fy = focal_lengths((90, 120))
    given = DepthOptions(intrinsics=f"{fx},{fy},61.5,44.0")
    result = engine.depth_of(grey_clip(9), given)
    assert model.focals == pytest.approx([np.sqrt(fx * fy) * 7 / 15] * len(model.focals))
    np.testing.assert_allclose(result.intrinsics, np.broadcast_to(given.known_intrinsics, (9, 3, 3)))
    assert result.valid.all()


def test_a_known_focal_length_replaces_the_estimated_field_of_view() -> None:
    maps = AnalyticModel().predict(np.full((2, 3, 42, 56), 60 / 255, np.float32))
    known = with_focal(maps, 50.0, 0.0)
    np.testing.assert_allclose(decode_cameras(known.pose_encoding, (42, 56), 0.0).intrinsics[:, 0, 0], 50, rtol=1e-5)
    np.testing.assert_allclose(decode_cameras(known.pose_encoding, (42, 56), 0.0).intrinsics[:, 1, 1], 50, rtol=1e-5)


@pytest.mark.parametrize("text", ["800", "800,800,320", "a,b,c,d", "0,800,320,240", "800,800,nan,240"])
def test_intrinsics_that_are_no_camera_are_refused_in_words(text: str) -> None:
    with pytest.raises(ValueError, match=r"fx,fy,cx,cy|positive"):
        DepthOptions(intrinsics=text)


def test_frames_come_out_while_the_clip_is_still_being_read() -> None:
    engine, model = analytic_engine()
    session = iter(engine.run(grey_clip(160), HEAD))
    first = [next(session).index for _ in range(4)]
    assert first == [0, 1, 2, 3]
    assert max(max(window) for window in model.windows) < 50


def test_stride_and_limit_keep_the_source_numbers_and_times() -> None:
    engine, _ = analytic_engine()
    frames = list(engine.run(grey_clip(40), DepthOptions(stride=3, max_frames=5, depth="head")))
    assert [frame.index for frame in frames] == [0, 3, 6, 9, 12]
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], np.array([0, 3, 6, 9, 12]) / 25)


def test_a_cut_begins_a_segment_in_a_world_of_its_own() -> None:
    engine, model = analytic_engine()
    clip = grey_clip(20)
    checks = np.indices(clip.size).sum(0) // 20 % 2
    frames = clip.frames.copy()
    frames[:9] = np.where(checks[..., None], frames[:9], [60, 60, 60]).astype(np.uint8)
    frames[9:] = np.where(checks[..., None], [60, 10, 10], frames[9:]).astype(np.uint8)
    result = engine.depth_of(Clip(frames, clip.timestamps_s), HEAD)
    np.testing.assert_array_equal(result.segment, [0] * 9 + [1] * 11)
    np.testing.assert_array_equal(result.world_from_camera[9], np.eye(4))
    assert "frame 9" in result.meta.warnings[0]
    assert not any({8, 9} <= set(window) for window in model.windows)


def test_black_borders_and_everything_behind_them_stay_empty() -> None:
    engine, _ = analytic_engine()
    clip = grey_clip(7, (90, 140))
    frames = clip.frames.copy()
    frames[:, :, :20] = 0
    result = engine.depth_of(Clip(frames, clip.timestamps_s))
    assert not result.valid[:, :, :20].any()
    assert result.valid[:, :, 22:].all()
    assert (result.depth[:, :, :20] == 0).all()
    assert (result.confidence[:, :, :20] == 0).all()
    middle = (20 + 140) / 2
    np.testing.assert_allclose(result.intrinsics[:, 0, 2], middle, atol=1e-6)


def test_a_network_that_returns_nonsense_is_an_error_not_a_result() -> None:
    engine, model = analytic_engine()

    def broken(*_: object) -> np.ndarray:
        return np.full((6, 9), np.nan, np.float32)

    model._encode = broken  # type: ignore[method-assign]
    with pytest.raises(GeometryError, match="pose_encoding"):
        engine.depth_of(grey_clip(6))


def test_a_closed_run_stops() -> None:
    engine, model = analytic_engine()
    session = engine.run(grey_clip(60), HEAD)
    frames = iter(session)
    next(frames)
    seen = len(model.windows)
    session.close()
    with pytest.raises(StoppedError):
        list(frames)
    assert len(model.windows) == seen


def test_a_missing_file_is_a_clip_error(tmp_path: Path) -> None:
    engine, _ = analytic_engine()
    with pytest.raises(ClipError, match="no such file"):
        list(engine.run(tmp_path / "nothing.mp4"))


def test_results_say_how_they_were_made() -> None:
    engine, _ = analytic_engine()
    meta = engine.depth_of(grey_clip(3), HEAD).meta
    assert meta.bundle == engine.bundle.id
    assert meta.depth == "head"
    assert meta.settings["input"]["window"] == 6
    assert {"network", "splat", "stitch", "total"} <= set(meta.timings_s)


def test_the_entry_point_leads_to_this_engine() -> None:
    assert engine_factory() is DepthEngine


def test_a_video_file_goes_all_the_way_through_decoder_graphs_and_splatter(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    from made_bundle import write_bundle
    from made_videos import ramp, write_video

    (tmp_path / "bundle").mkdir()
    engine = DepthEngine(write_bundle(tmp_path / "bundle"), EngineSettings(threads=1))
    video = write_video(tmp_path / "clip.mp4", [ramp(i) for i in range(9)])
    result = engine.depth_of(video)
    assert result.depth.shape == (9, 48, 64)
    assert result.meta.name == "clip"
    assert result.meta.complete
    assert result.valid.all()
    assert (result.depth > 0).all()
    assert np.isfinite(result.confidence).all()
    np.testing.assert_allclose(result.timestamps_s, np.arange(9) / 25, atol=1e-6)

"""The files of one clip: each is read back by something that did not write it."""

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from clips_on_disk import pictures, write_images, write_video
from fake_engine import plane

from bathyscope.errors import ClipError
from bathyscope.result import ClipDepth, FrameDepth, ResultMeta
from bathyscope.result_files import save_npz
from bathyscope.result_zip import load_zip
from bathyscope.tum import read_tum
from bathyscope_client.depth_colours import ClipRange, colour_depth, measure_range
from bathyscope_client.outputs import made_of, output_paths, write_outputs
from bathyscope_client.point_cloud import VERTEX, steep
from bathyscope_client.source_frames import source_frames
from bathyscope_client.upload import pack_images

SIZE = (24, 32)


def at(frame: FrameDepth, time_s: float, segment: int = 0) -> FrameDepth:
    return FrameDepth(
        frame.index,
        time_s,
        frame.depth,
        frame.confidence,
        frame.valid,
        frame.world_from_camera,
        frame.intrinsics,
        segment,
    )


def make(tmp_path: Path, source: Path, frames: list[FrameDepth], points: int = 10_000) -> dict[str, Path]:
    paths = output_paths(tmp_path, "colon")
    save_npz(paths["depth"], ClipDepth.from_frames(frames, ResultMeta(name="colon")))
    write_outputs(source, paths, points, lambda done, total: None)
    return paths


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("outputs")
    source = write_video(folder / "source.mp4", 6, SIZE)
    return make(folder, source, [plane(t, SIZE) for t in range(6)])


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return data[:end].decode().splitlines(), np.frombuffer(data[end:], VERTEX)


def test_cloud_points_lie_on_the_plane_they_were_made_of(made: dict[str, Path]) -> None:
    header, vertices = read_ply(made["cloud"])
    assert f"element vertex {len(vertices)}" in header
    assert len(vertices) > 1000
    x, y, z = vertices["position"].T
    seen_from = np.round((np.subtract.outer(x, 0.1 * np.arange(6))) / z[:, None] * SIZE[1] + SIZE[1] / 2 - 0.5, 3)
    expected = 1.0 + seen_from / (SIZE[1] - 1)
    assert np.abs(expected - z[:, None]).min(1).max() < 1e-3
    assert (np.abs(y) <= z * SIZE[0] / SIZE[1] / 2).all()


def test_cloud_colours_come_from_the_source(made: dict[str, Path]) -> None:
    _, vertices = read_ply(made["cloud"])
    reds = np.unique(pictures(6, SIZE)[..., 0])
    assert (np.abs(vertices["colour"][:, :1].astype(int) - reds).min(1) <= 6).all()


@pytest.mark.skipif(not hasattr(cv2, "loadPointCloud"), reason="this OpenCV reads no point clouds")
def test_cloud_loads_in_another_tool(made: dict[str, Path]) -> None:
    loaded = np.asarray(cv2.loadPointCloud(str(made["cloud"]))[0]).reshape(-1, 3)
    np.testing.assert_array_equal(loaded, read_ply(made["cloud"])[1]["position"])


def test_cloud_has_no_more_points_than_asked_for(tmp_path: Path) -> None:
    source = write_video(tmp_path / "s.mp4", 3, SIZE)
    paths = make(tmp_path, source, [plane(t, SIZE) for t in range(3)], points=50)
    assert 0 < len(read_ply(paths["cloud"])[1]) <= 50


def test_cloud_leaves_unsure_pixels_and_depth_edges_out(tmp_path: Path) -> None:
    frame = plane(0, SIZE)
    confidence = np.where(np.arange(SIZE[0])[:, None] < 6, 0.1, 1.0) * frame.valid
    stepped = np.where(np.arange(SIZE[1]) < 16, 1.0, 3.0) * frame.valid
    frame = FrameDepth(0, 0.0, stepped.astype(np.float32), confidence, frame.valid, np.eye(4), frame.intrinsics)
    paths = make(tmp_path, write_video(tmp_path / "s.mp4", 1, SIZE), [frame])
    x, y, z = read_ply(paths["cloud"])[1]["position"].T
    rows, columns = y / z * SIZE[1] + SIZE[0] / 2, x / z * SIZE[1] + SIZE[1] / 2
    assert rows.min() >= 6
    assert not ((columns > 15) & (columns < 17)).any()


def test_steep_marks_both_sides_of_a_jump_and_no_slope() -> None:
    slope = np.tile(np.linspace(1, 2, 100, dtype=np.float32), (5, 1))
    assert not steep(slope).any()
    jump = np.where(np.arange(10) < 5, 1.0, 2.0)[None].repeat(5, 0)
    assert np.flatnonzero(steep(jump)[2]).tolist() == [4, 5]


def test_cloud_keeps_to_the_longest_segment(tmp_path: Path) -> None:
    frames = [at(plane(t, SIZE), t / 25, segment=int(t >= 1)) for t in range(4)]
    far = frames[0]
    frames[0] = FrameDepth(0, 0.0, far.depth * 100, far.confidence, far.valid, np.eye(4), far.intrinsics, 0)
    header, vertices = read_ply(make(tmp_path, write_video(tmp_path / "s.mp4", 4, SIZE), frames)["cloud"])
    assert vertices["position"][:, 2].max() <= 2.0
    assert "comment world of segment 1 of 2" in "\n".join(header)


def read_video(path: Path) -> tuple[list[float], list[np.ndarray]]:
    with av.open(path) as container:
        frames = list(container.decode(video=0))
        return [frame.time for frame in frames], [frame.to_ndarray(format="rgb24") for frame in frames]


def test_preview_shows_the_source_left_and_its_depth_right(made: dict[str, Path]) -> None:
    _, images = read_video(made["preview"])
    assert len(images) == 6
    span = measure_range([plane(0, SIZE)])
    for t, image in enumerate(images):
        assert image.shape == (SIZE[0], 2 * SIZE[1], 3)
        left, right = image[:, : SIZE[1]].astype(float), image[:, SIZE[1] :].astype(float)
        assert np.abs(left[4:-4, 4:-4] - pictures(6, SIZE)[t, 4:-4, 4:-4]).mean() < 8
        assert np.abs(right - colour_depth(plane(t, SIZE).depth, plane(t, SIZE).valid, span))[4:-4, 4:-4].mean() < 25


def test_preview_keeps_uneven_times(tmp_path: Path) -> None:
    times = [0.0, 0.04, 0.2, 0.25]
    source = write_video(tmp_path / "s.mp4", 4, SIZE, times)
    paths = make(tmp_path, source, [at(plane(t, SIZE), time) for t, time in enumerate(times)])
    np.testing.assert_allclose(read_video(paths["preview"])[0], times, atol=1e-3)


def test_colours_are_the_same_for_the_same_depth_in_every_frame() -> None:
    near, far = plane(0, SIZE), plane(0, SIZE)
    far = FrameDepth(1, 0.1, far.depth * 3, far.confidence, far.valid, far.world_from_camera, far.intrinsics)
    span = measure_range([near, far])
    assert span.near == pytest.approx(1.03, abs=0.05)
    assert span.far == pytest.approx(5.9, abs=0.15)
    one = colour_depth(np.full((1, 1), 2.0), np.ones((1, 1), bool), span)
    row = colour_depth(np.array([[1.0, 2.0, 5.0]]), np.array([[True, True, False]]), span)
    assert one[0, 0].tolist() == row[0, 1].tolist()
    assert row[0, 2].tolist() == [0, 0, 0]
    assert row[0, 0, 0] > row[0, 0, 2], "near is warm"


def test_range_of_a_long_clip_keeps_few_samples_and_hardly_changes() -> None:
    span = measure_range(at(plane(0, (64, 64)), t / 25) for t in range(1500))
    assert span == ClipRange(span.near, span.far, 1.0, 1500, 0, 1)
    assert (span.near, span.far) == (pytest.approx(1.03, abs=0.01), pytest.approx(1.98, abs=0.01))


def test_range_of_a_clip_without_valid_pixels_exists() -> None:
    empty = plane(0, SIZE)
    empty = FrameDepth(0, 0.0, empty.depth, empty.confidence, empty.valid & False, np.eye(4), empty.intrinsics)
    assert measure_range([empty]).frames == 1


def test_poses_are_tum_lines(made: dict[str, Path]) -> None:
    times, poses = read_tum(made["poses"])
    np.testing.assert_allclose(times, np.arange(6) / 25)
    np.testing.assert_allclose(poses, [plane(t, SIZE).world_from_camera for t in range(6)], atol=1e-12)


def test_intrinsics_are_pixels_of_the_source(made: dict[str, Path]) -> None:
    found = json.loads(made["intrinsics"].read_text())
    assert {name: found[name] for name in ("height", "width", "fx", "fy", "cx", "cy")} == {
        "height": 24, "width": 32, "fx": 32, "fy": 32, "cx": 16, "cy": 12,
    }  # fmt: skip
    assert len(found["frames"]) == 6


def test_zip_is_the_same_result(made: dict[str, Path]) -> None:
    np.testing.assert_allclose(load_zip(made["pictures"]).depth[5], plane(5, SIZE).depth, atol=2 / 32768)


def test_sheet_has_frames_over_depth(made: dict[str, Path]) -> None:
    sheet = cv2.imread(str(made["sheet"]))[..., ::-1]
    first = sheet[:24, :32]
    assert np.abs(first.astype(int) - pictures(1, SIZE)[0]).mean() < 8
    below = sheet[24:48, :32]
    assert below[12, 2, 0] > below[12, 2, 2]
    assert below[12, 30, 2] > below[12, 30, 0]


@pytest.mark.parametrize("zipped", [False, True])
def test_images_are_paired_in_natural_order(tmp_path: Path, zipped: bool) -> None:
    source = write_images(tmp_path / "images", 12, SIZE)
    if zipped:
        with (tmp_path / "images.zip").open("wb") as file:
            pack_images(source, file)
        source = tmp_path / "images.zip"
    frames = list(source_frames(source))
    np.testing.assert_array_equal(np.stack([frame.image for frame in frames]), pictures(12, SIZE))
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], np.arange(12) / 25)


def test_a_result_of_another_video_is_not_painted_over_this_one(tmp_path: Path) -> None:
    source = write_video(tmp_path / "s.mp4", 2, SIZE)
    with pytest.raises(ClipError, match=r"no frame at 0\.0800 s"):
        make(tmp_path, source, [plane(t, SIZE) for t in range(3)])


def test_a_damaged_picture_leaves_a_gap_in_time(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", 4, SIZE)
    (folder / "f1.png").write_bytes(b"damaged")
    (folder / "f2.png").write_bytes(b"")
    assert [frame.timestamp_s for frame in source_frames(folder)] == [0.0, 3 / 25]


def test_a_file_that_is_no_video_is_a_clip_error(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"text")
    with pytest.raises(ClipError, match=r"a\.mp4"):
        list(source_frames(tmp_path / "a.mp4"))


def test_a_result_of_disparity_alone_gives_pictures_and_no_cameras(tmp_path: Path) -> None:
    source = write_video(tmp_path / "source.mp4", 3, SIZE)
    paths = output_paths(tmp_path, "colon")
    meta = ResultMeta(name="colon", outputs=("disparity",), scale="affine")
    seen = [plane(t, SIZE) for t in range(3)]
    disparity = [
        FrameDepth(f.index, f.timestamp_s, f.valid / np.maximum(f.depth, 1), None, f.valid, None, None) for f in seen
    ]
    save_npz(paths["depth"], ClipDepth.from_frames(disparity, meta))
    write_outputs(source, paths, 100, lambda done, total: None)
    assert {kind for kind, path in paths.items() if path.is_file()} == set(made_of(meta))
    assert set(made_of(meta)) == {"depth", "pictures", "preview", "sheet"}


def test_disparity_is_coloured_as_its_inverse() -> None:
    depth = plane(0, SIZE)
    flipped = FrameDepth(0, 0.0, depth.valid / np.maximum(depth.depth, 1), None, depth.valid, None, None)
    span, other = measure_range([depth]), measure_range([flipped], disparity=True)
    assert (other.near, other.far) == (pytest.approx(span.near, rel=1e-5), pytest.approx(span.far, rel=1e-5))
    expected = colour_depth(depth.depth, depth.valid, span)
    observed = colour_depth(flipped.depth, flipped.valid, other)
    assert np.abs(expected.astype(int) - observed).max() <= 2

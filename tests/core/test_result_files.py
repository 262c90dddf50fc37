"""Result files: npz and zip keep what they must, and refuse what is not a result."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

from bathyscope.errors import GeometryError, ResultError
from bathyscope.png import decode_grey
from bathyscope.result import ARRAY_NAMES, BundleId, ClipDepth, FrameDepth, ResultMeta
from bathyscope.result_files import NpzReader, NpzWriter, load_npz, save_npz
from bathyscope.result_zip import load_zip, save_zip, write_zip
from bathyscope.tum import read_tum, tum_lines

META = ResultMeta(
    name="colon ü",
    depth="head",
    bundle=BundleId(name="toy", version="1", digest="0" * 64),
    software="bathyscope 0",
    complete=False,
    warnings=("cut at 3 s",),
    settings={"stride": 2, "window": [16, 4]},
    timings_s={"network": 0.1 + 0.2},
)


def result(frames: int = 5, size: tuple[int, int] = (6, 9), dtype: type = np.float32, seed: int = 0) -> ClipDepth:
    rng = np.random.default_rng(seed)
    h, w = size
    valid = rng.random((frames, h, w)) > 0.2
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[1:, :3, :3] = Rotation.random(frames - 1, random_state=seed).as_matrix() if frames > 1 else 0
    poses[1:, :3, 3] = rng.normal(size=(frames - 1, 3))
    return ClipDepth(
        depth=np.where(valid, rng.uniform(0.3, 7, (frames, h, w)), 0).astype(dtype),
        confidence=rng.uniform(0, 1, (frames, h, w)).astype(dtype),
        valid=valid,
        world_from_camera=poses,
        intrinsics=np.tile(np.array([[50.1, 0, w / 2], [0, 51.2, h / 2], [0, 0, 1]]), (frames, 1, 1)),
        timestamps_s=np.cumsum(rng.uniform(0.01, 0.1, frames)),
        segment=(np.arange(frames) >= 3).astype(np.int32),
        meta=META,
    )


def assert_same(found: ClipDepth, expected: ClipDepth, names: tuple[str, ...] = ARRAY_NAMES) -> None:
    for name in names:
        assert getattr(found, name).dtype == getattr(expected, name).dtype, name
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert found.meta == expected.meta


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("frames", [1, 5])
def test_npz_keeps_every_bit(tmp_path: Path, frames: int, dtype: type) -> None:
    clip = result(frames, dtype=dtype)
    assert_same(load_npz(save_npz(tmp_path / "r.npz", clip)), clip)


def test_npz_is_an_ordinary_one_without_pickles(tmp_path: Path) -> None:
    clip = result()
    with np.load(save_npz(tmp_path / "r.npz", clip), allow_pickle=False) as arrays:
        assert set(arrays) == {*ARRAY_NAMES, "meta"}
        assert_array_equal(arrays["depth"], clip.depth)
        assert ResultMeta.model_validate_json(str(arrays["meta"])) == clip.meta


def test_npz_frames_can_be_read_one_by_one(tmp_path: Path) -> None:
    clip = result()
    with NpzReader(save_npz(tmp_path / "r.npz", clip)) as reader:
        assert (len(reader), reader.size) == (5, (6, 9))
        for t, frame in enumerate(reader):
            assert (frame.index, frame.timestamp_s, frame.segment) == (t, clip.timestamps_s[t], clip.segment[t])
            assert_array_equal(frame.depth, clip.depth[t])
            assert_array_equal(frame.valid, clip.valid[t])


def test_the_same_result_makes_the_same_bytes(tmp_path: Path) -> None:
    first, second = save_npz(tmp_path / "a.npz", result()), save_npz(tmp_path / "b.npz", result())
    assert first.read_bytes() == second.read_bytes()
    assert write_zip(first, tmp_path / "a.zip").read_bytes() == write_zip(second, tmp_path / "b.zip").read_bytes()


def test_a_writer_that_is_left_early_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    clip = result()
    before = save_npz(tmp_path / "r.npz", clip).read_bytes()
    with suppress(ZeroDivisionError), NpzWriter(tmp_path / "r.npz") as writer:
        writer.append(clip.frame(0))
        raise ZeroDivisionError
    assert (tmp_path / "r.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["r.npz"]


def test_a_finished_writer_leaves_only_its_file(tmp_path: Path) -> None:
    save_npz(tmp_path / "r.npz", result())
    assert [path.name for path in tmp_path.iterdir()] == ["r.npz"]


def test_a_result_without_frames_is_refused(tmp_path: Path) -> None:
    with NpzWriter(tmp_path / "r.npz") as writer, pytest.raises(ResultError, match="at least one frame"):
        writer.close(META)
    assert not list(tmp_path.iterdir())


def changed(frame: FrameDepth, **values: Any) -> FrameDepth:
    fields = {name: getattr(frame, name) for name in FrameDepth.__slots__}
    return FrameDepth(**{**fields, **values})


def test_frames_of_another_size_or_with_depth_that_is_not_finite_are_refused(tmp_path: Path) -> None:
    clip, small = result(), result(size=(3, 4))
    nan = clip.depth[1].copy()
    nan[0, 0] = np.nan
    with NpzWriter(tmp_path / "r.npz") as writer:
        writer.append(clip.frame(0))
        with pytest.raises(GeometryError, match=r"is \(3, 4\), the frames before are \(6, 9\)"):
            writer.append(small.frame(1))
        with pytest.raises(GeometryError, match="not finite"):
            writer.append(changed(clip.frame(1), depth=nan))
        assert len(writer) == 1


def test_the_writer_does_not_hold_on_to_buffers_that_its_caller_reuses(tmp_path: Path) -> None:
    clip = result()
    with NpzWriter(tmp_path / "r.npz") as writer:
        pose, depth = np.eye(4), np.zeros((6, 9), np.float32)
        for t in range(3):
            pose[0, 3], depth[:] = t, 1 + t
            writer.append(changed(clip.frame(t), world_from_camera=pose, depth=depth))
        writer.close(META)
    loaded = load_npz(tmp_path / "r.npz")
    assert loaded.world_from_camera[:, 0, 3].tolist() == [0, 1, 2]
    assert loaded.depth[:, 0, 0].tolist() == [1, 2, 3]


def test_zip_keeps_everything_but_rounds_maps_to_one_step_of_the_clip(tmp_path: Path) -> None:
    clip = result()
    loaded = load_zip(save_zip(tmp_path / "r.zip", clip))
    assert_same(loaded, clip, ("valid", "world_from_camera", "intrinsics", "timestamps_s", "segment"))
    for found, expected in ((loaded.depth, clip.depth), (loaded.confidence, clip.confidence)):
        assert 0 < np.abs(found - expected).max() <= expected.max() / 65535


def test_zip_read_and_written_again_is_the_same_file(tmp_path: Path) -> None:
    first = save_zip(tmp_path / "a.zip", result())
    second = save_zip(tmp_path / "b.zip", load_zip(first))
    assert first.read_bytes() == second.read_bytes()


def test_zip_from_npz_is_zip_from_memory(tmp_path: Path) -> None:
    clip = result()
    npz = save_npz(tmp_path / "r.npz", clip)
    assert write_zip(npz, tmp_path / "a.zip").read_bytes() == save_zip(tmp_path / "b.zip", clip).read_bytes()


def test_depth_of_a_zip_is_read_by_anyone_and_zero_only_where_there_is_nothing(tmp_path: Path) -> None:
    clip = result()
    clip.depth[2, 1, 1] = 1e-7
    with zipfile.ZipFile(save_zip(tmp_path / "r.zip", clip)) as archive:
        index = json.loads(archive.read("result.json"))
        values = decode_grey(archive.read("depth/000002.png"))
    np.testing.assert_allclose(values * index["depth_scale"], clip.depth[2], atol=1.01 * index["depth_scale"])
    assert_array_equal(values == 0, clip.depth[2] == 0)


def test_a_clip_without_any_depth_survives_both_files(tmp_path: Path) -> None:
    clip = result()
    clip.depth[:], clip.confidence[:] = 0, 0
    assert_same(load_zip(save_zip(tmp_path / "r.zip", clip)), clip)
    assert_same(load_npz(save_npz(tmp_path / "r.npz", clip)), clip)


def test_zip_poses_are_the_results_in_tum_order(tmp_path: Path) -> None:
    clip = result()
    with zipfile.ZipFile(save_zip(tmp_path / "r.zip", clip)) as archive:
        lines = archive.read("poses.txt").decode().splitlines()
    table = np.array([line.split() for line in lines], float)
    assert_array_equal(table[:, 0], clip.timestamps_s)
    assert_array_equal(table[:, 1:4], clip.world_from_camera[:, :3, 3])
    np.testing.assert_allclose(
        Rotation.from_quat(table[:, 4:]).as_matrix(), clip.world_from_camera[:, :3, :3], atol=1e-12
    )


def test_tum_text_reads_back(tmp_path: Path) -> None:
    clip = result()
    (tmp_path / "poses.txt").write_text("# comment\n\n" + "".join(tum_lines(clip.timestamps_s, clip.world_from_camera)))
    stamps, poses = read_tum(tmp_path / "poses.txt")
    assert_array_equal(stamps, clip.timestamps_s)
    np.testing.assert_allclose(poses, clip.world_from_camera, atol=1e-12)


@pytest.mark.parametrize(("line", "what"), [("1 2 3", "8 numbers, got 3"), ("a b c d e f g h", "could not convert")])
def test_a_tum_line_that_is_wrong_is_named(tmp_path: Path, line: str, what: str) -> None:
    (tmp_path / "poses.txt").write_text("# comment\n" + line)
    with pytest.raises(ResultError, match=f"line 2: .*{what}"):
        read_tum(tmp_path / "poses.txt")


def rewrite(path: Path, **arrays: Any) -> None:
    """The npz with some arrays replaced; None leaves one out."""
    with np.load(path) as old:
        new = {**{name: old[name] for name in old}, **arrays}
    np.savez(path, **{name: array for name, array in new.items() if array is not None})


NEWER = META.model_copy(update={"format": 99}).model_dump_json()
WRONG_NPZ: dict[str, tuple[dict[str, Any], str]] = {
    "no depth": ({"depth": None}, "depth"),
    "no poses": ({"world_from_camera": None}, "world_from_camera"),
    "no meta data": ({"meta": None}, "meta"),
    "newer format": ({"meta": np.array(NEWER)}, "format 99 is newer .* upgrade"),
    "meta data in words": ({"meta": np.array("hello")}, "meta data cannot be read"),
    "meta data that are a list": ({"meta": np.array("[1]")}, "meta data cannot be read"),
    "unknown meta data": ({"meta": np.array('{"format": 1, "evil": 1}')}, "meta data cannot be read"),
    "poses of other frames": ({"world_from_camera": np.zeros((4, 4, 4))}, "do not belong together"),
    "maps of another size": ({"valid": np.zeros((5, 6, 8), np.bool_)}, "do not belong together"),
    "flat depth": ({"depth": np.zeros((5, 6), np.float32)}, "depth"),
    "depth in columns": ({"depth": np.asfortranarray(np.zeros((5, 6, 9), np.float32))}, "Fortran order"),
    "objects for depth": ({"depth": np.full((5, 6, 9), None, object)}, "depth"),
    "objects for poses": ({"world_from_camera": np.full((5, 4, 4), None, object)}, "world_from_camera"),
    "names for segments": ({"segment": np.array(["a"] * 5)}, "segment is <U1"),
    "whole numbers for poses": ({"world_from_camera": np.zeros((5, 4, 4), int)}, "world_from_camera is int64"),
    "complex depth": ({"depth": np.zeros((5, 6, 9), np.complex64)}, "depth"),
}


@pytest.mark.parametrize(("arrays", "message"), WRONG_NPZ.values(), ids=WRONG_NPZ)
def test_an_npz_that_is_no_result_is_refused(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = save_npz(tmp_path / "r.npz", result())
    rewrite(path, **arrays)
    with pytest.raises(ResultError, match=message):
        load_npz(path)


def test_an_npz_that_claims_more_than_it_holds_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "r.npz", result())
    data = path.read_bytes()
    claims = data.replace(b"(5, 6, 9), }          ", b"(5, 99999999, 99999), }")
    claims = claims.replace(b"(5, 4, 4), }        ", b"(5, 99999999, 4), }")
    assert claims.count(b"99999999") > 3
    path.write_bytes(claims)
    with pytest.raises(ResultError):
        load_npz(path)


READERS: dict[str, tuple[Callable[[Path, ClipDepth], Path], Callable[[Path], ClipDepth]]] = {
    "npz": (save_npz, load_npz),
    "zip": (save_zip, load_zip),
}


@pytest.mark.parametrize(("save", "load"), READERS.values(), ids=READERS)
def test_no_damage_does_worse_than_a_result_error(
    tmp_path: Path, save: Callable[[Path, ClipDepth], Path], load: Callable[[Path], ClipDepth]
) -> None:
    path = save(tmp_path / "r", result(2, (3, 4)))
    whole = path.read_bytes()
    for position in range(0, len(whole), 17):
        data = bytearray(whole)
        data[position] ^= 0xFF
        path.write_bytes(data)
        with suppress(ResultError, GeometryError):
            load(path)
    for length in range(0, len(whole), 61):
        path.write_bytes(whole[:length])
        with pytest.raises(ResultError):
            load(path)


@pytest.mark.parametrize(("save", "load"), READERS.values(), ids=READERS)
def test_a_path_that_is_not_there_is_a_result_error(
    tmp_path: Path, save: Callable[[Path, ClipDepth], Path], load: Callable[[Path], ClipDepth]
) -> None:
    with pytest.raises(ResultError, match="nowhere"):
        load(tmp_path / "nowhere")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_packed_again_by_another_tool_is_read_or_refused(tmp_path: Path, method: int) -> None:
    clip = result(2, (3, 4))
    source, packed = save_zip(tmp_path / "r.zip", clip), tmp_path / "packed.zip"
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(packed, "w", method) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    whole = packed.read_bytes()
    for position in range(0, len(whole), 11):
        data = bytearray(whole)
        data[position] ^= 0xFF
        packed.write_bytes(data)
        with suppress(ResultError, GeometryError):
            load_zip(packed)


def test_maps_in_a_zip_that_are_not_of_the_stated_size_are_refused(tmp_path: Path) -> None:
    source, other = save_zip(tmp_path / "a.zip", result()), tmp_path / "b.zip"
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(other, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "result.json":
                data = json.dumps({**json.loads(data), "size": [6, 8]}).encode()
            new.writestr(name, data)
    with pytest.raises(ResultError, match=r"depth/000000\.png is \(6, 9\), result\.json says \(6, 8\)"):
        load_zip(other)


def without_cameras(frames: int = 4) -> ClipDepth:
    whole = result(frames)
    meta = META.model_copy(update={"outputs": ("disparity",), "scale": "affine"})
    return ClipDepth(whole.depth, None, whole.valid, None, None, whole.timestamps_s, whole.segment, meta)


@pytest.mark.parametrize("ending", ["npz", "zip"])
def test_a_result_without_cameras_keeps_what_it_has_and_has_no_more(tmp_path: Path, ending: str) -> None:
    clip = without_cameras()
    path = tmp_path / f"a.{ending}"
    found = load_npz(save_npz(path, clip)) if ending == "npz" else load_zip(save_zip(path, clip))
    assert found.meta == clip.meta
    assert (found.confidence, found.world_from_camera, found.intrinsics) == (None, None, None)
    np.testing.assert_allclose(found.depth, clip.depth, atol=2**-12)
    assert_array_equal(found.valid, clip.valid)
    with zipfile.ZipFile(path) as archive:
        names = " ".join(archive.namelist())
    for absent in ("confidence", "world_from_camera", "intrinsics.npy", "poses.txt"):
        assert absent not in names


def test_meta_data_that_promises_cameras_which_are_not_there_is_refused(tmp_path: Path) -> None:
    clip = without_cameras()
    with pytest.raises(GeometryError, match=r"outputs \('depth', 'confidence', 'cameras'\); confidence is missing"):
        ClipDepth(clip.depth, None, clip.valid, None, None, clip.timestamps_s, clip.segment, META)
    with NpzWriter(tmp_path / "a.npz") as writer:
        writer.append(clip.frame(0))
        with pytest.raises(GeometryError, match=r"frame 0 has .* before have"):
            writer.append(result().frame(0))
        with pytest.raises(ResultError, match="its meta data says"):
            writer.close(META)
    with pytest.raises(GeometryError, match="1 of 2 frames lack"):
        ClipDepth.from_frames([clip.frame(0), result(4).frame(1)], META)


def test_results_of_the_first_format_are_still_read(tmp_path: Path) -> None:
    clip = result()
    old = clip.meta.model_dump(mode="json") | {"format": 1}
    del old["outputs"]
    arrays = {name: getattr(clip, name) for name in ARRAY_NAMES}
    np.savez(tmp_path / "old.npz", **arrays, meta=np.array(json.dumps(old)))
    found = load_npz(tmp_path / "old.npz")
    assert found.meta.outputs == ("depth", "confidence", "cameras")
    assert_array_equal(found.world_from_camera, clip.world_from_camera)

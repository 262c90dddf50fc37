"""Clips repeat by seed, keep to their domain, and survive the disk."""

import hashlib
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from bathyscope.errors import DatasetError, SettingsError
from bathyscope_train.data.synthetic import (
    DOMAINS,
    Domain,
    SyntheticClip,
    clip_paths,
    read_clip,
    render_clip,
    write_clips,
    write_dataset_folder,
)
from bathyscope_train.data.synthetic.clip import draw_scene
from bathyscope_train.data.synthetic.optics import Sensor, develop, gains
from bathyscope_train.evaluation.folders import DatasetFolder

SIZE = (28, 35)


def digest(clip: SyntheticClip) -> str:
    arrays = (clip.frames, clip.depth, clip.valid, clip.world_from_camera, clip.intrinsics)
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def always_masked() -> Domain:
    broad = DOMAINS["broad"]
    sensor = {"round_view": 1.0, "compressed": 0.0, "overlay": 0.0}
    return broad.model_copy(update={"sensor": broad.sensor.model_copy(update=sensor)})


def test_the_same_seed_gives_the_same_bytes_in_another_process() -> None:
    program = (
        "import hashlib\n"
        "from bathyscope_train.data.synthetic import DOMAINS, render_clip\n"
        "for domain in ('source', 'broad'):\n"
        f"    clip = render_clip(7, DOMAINS[domain], frames=2, size={SIZE})\n"
        "    arrays = (clip.frames, clip.depth, clip.valid, clip.world_from_camera, clip.intrinsics)\n"
        "    print(hashlib.sha256(b''.join(array.tobytes() for array in arrays)).hexdigest())\n"
    )
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    here = [digest(render_clip(7, DOMAINS[name], frames=2, size=SIZE)) for name in ("source", "broad")]
    assert other.stdout.split() == here


def test_other_seeds_and_domains_give_other_clips() -> None:
    clips = [
        render_clip(seed, DOMAINS[name], frames=1, size=SIZE)
        for seed, name in ((1, "source"), (2, "source"), (1, "broad"))
    ]
    assert len({digest(clip) for clip in clips}) == 3


def distances(clip: SyntheticClip) -> np.ndarray:
    """From the lens, along the rays of a pinhole: what a wall beside the camera is near by."""
    height, width = clip.depth.shape[1:]
    x = (np.arange(width) + 0.5 - clip.intrinsics[0, 2]) / clip.intrinsics[0, 0]
    y = (np.arange(height) + 0.5 - clip.intrinsics[1, 2]) / clip.intrinsics[1, 1]
    return (clip.depth * np.sqrt(1 + x**2 + y[:, None] ** 2))[clip.valid]


@pytest.mark.parametrize("name", sorted(DOMAINS))
def test_every_domain_gives_lit_frames_with_depth_in_millimetres(name: str) -> None:
    for seed in range(3):
        clip = render_clip(seed, DOMAINS[name], frames=3, size=SIZE)
        assert clip.frames.dtype == np.uint8
        assert clip.frames.shape == (3, *SIZE, 3)
        assert clip.depth.dtype == np.float32
        assert clip.valid.mean() > 0.4
        assert ((clip.depth > 0) == clip.valid).all()
        seen = clip.depth[clip.valid]
        nearest = distances(clip).min() if DOMAINS[name].camera.hugging else seen.min()
        assert 0.3 < nearest < np.median(seen) < seen.max() < 400
        assert 40 < clip.frames[clip.valid].mean() < 200
        assert clip.frames[clip.valid].std() > 8


@pytest.mark.parametrize("name", sorted(DOMAINS))
def test_tissue_is_never_greener_than_red_nor_bluer_than_green(name: str) -> None:
    for seed in range(3):
        albedo = draw_scene(seed, DOMAINS[name]).tissue.albedo
        assert (albedo[..., 0] >= albedo[..., 1] - 1e-6).all()
        assert (albedo[..., 1] >= albedo[..., 2] - 1e-6).all()
        assert albedo.max() <= 1.0


def test_the_field_of_view_keeps_to_the_domain_and_the_principal_point_to_the_middle() -> None:
    for seed in range(5):
        intrinsics = render_clip(seed, DOMAINS["broad"], frames=1, size=SIZE).intrinsics
        angle = np.degrees(2 * np.arctan(SIZE[1] / 2 / intrinsics[0, 0]))
        assert 40 <= angle <= 110
        np.testing.assert_array_equal(intrinsics[:2, 2], (SIZE[1] / 2, SIZE[0] / 2))


def test_outside_a_round_view_nothing_is_valid_and_nothing_shines() -> None:
    dark, bright = [], []
    for seed in range(4):
        clip = render_clip(seed, always_masked(), frames=2, size=SIZE)
        outside = cv2.erode(np.uint8(~clip.valid[0]), np.ones((5, 5), np.uint8), borderValue=1) > 0
        assert (~clip.valid[0]).any()
        assert (clip.depth[~clip.valid] == 0).all()
        dark.append(clip.frames[0][outside].max(initial=0))
        bright.append(clip.frames[0][clip.valid[0]].mean())
    assert max(dark) < 30 < min(bright)


def plain_sensor(**changes: object) -> Sensor:
    numbers = dict.fromkeys(("lag", "vignette", "shoulder", "noise", "blur_px"), 0.0)
    rest = {"gamma": 2.0, "exposure": 0.5, "metering": 60.0, "clipping": 1.0, "quality": None}
    return Sensor(**(numbers | rest | {"view": np.ones(SIZE, np.float32)} | changes))  # type: ignore[arg-type]


def test_automatic_exposure_follows_a_jump_with_the_stated_lag() -> None:
    radiance = np.ones((4, *SIZE, 3), np.float32) * np.array([1, 4, 4, 4], np.float32)[:, None, None, None]
    expected = [0.25, 0.25 * 4**-0.25, 0.25 * 4 ** -(1 - 0.75**2), 0.25 * 4 ** -(1 - 0.75**3)]
    np.testing.assert_allclose(gains(radiance, plain_sensor(lag=0.75)), expected, rtol=1e-5)


def test_a_plain_sensor_shows_the_metered_grey_and_its_gamma() -> None:
    radiance = np.full((1, *SIZE, 3), 0.07, np.float32)
    radiance[0, 0] = 0.07 / 4
    frame = develop(np.random.default_rng(0), radiance, plain_sensor())[0]
    assert (frame[1:] == 128).all()  # exposure 0.5
    assert (frame[0] == 64).all()  # a quarter of the light at gamma 2


@pytest.mark.parametrize(("metering", "shown"), [(25.0, (128, 255)), (75.0, (64, 128))], ids=["dark half", "lit half"])
def test_exposure_is_that_of_the_metered_percentile(metering: float, shown: tuple[int, int]) -> None:
    radiance = np.full((1, *SIZE, 3), 0.1, np.float32)
    radiance[0, 14:] = 0.4  # four times the light, twice the level at gamma 2
    frame = develop(np.random.default_rng(0), radiance, plain_sensor(metering=metering))[0]
    assert (frame[0, 0, 0], frame[-1, 0, 0]) == shown


def test_the_corners_lose_what_the_vignette_says() -> None:
    radiance = np.full((1, 101, 101, 3), 1.0, np.float32)
    sensor = plain_sensor(vignette=0.4, gamma=1.0, view=np.ones((101, 101), np.float32))
    frame = develop(np.random.default_rng(0), radiance, sensor)[0].astype(float)
    assert frame[0, 0, 0] / frame[50, 50, 0] == pytest.approx(0.6, abs=0.02)


def test_named_domains_carry_their_names_and_the_first_is_what_ranges_default_to() -> None:
    assert [domain.name for domain in DOMAINS.values()] == list(DOMAINS)
    assert DOMAINS["source"] == Domain(name="source")
    with pytest.raises(KeyError, match="sunny"):
        DOMAINS["sunny"]


def test_a_domain_survives_its_file(tmp_path: Path) -> None:
    path = tmp_path / "broad.json"
    path.write_text(DOMAINS["broad"].model_dump_json(), encoding="utf-8")
    assert Domain.from_file(path) == DOMAINS["broad"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"name": "x", "gravity": 1}', "gravity"),
        ('{"name": "x", "light": {"falloff": [2, 1]}}', "from low to high"),
        ('{"name": "x", "families": {"lumen": 0}}', "positive sum"),
        ("not json", "not a domain"),
    ],
    ids=["unknown key", "reversed range", "no family", "no json"],
)
def test_a_wrong_domain_file_is_refused_with_its_reason(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "wrong.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=words):
        Domain.from_file(path)


@pytest.mark.parametrize(("seed", "frames", "size"), [(-1, 4, SIZE), (0, 0, SIZE), (0, 4, (4, 35))])
def test_a_clip_that_cannot_be_is_refused(seed: int, frames: int, size: tuple[int, int]) -> None:
    with pytest.raises(SettingsError, match="needs a seed"):
        render_clip(seed, DOMAINS["source"], frames=frames, size=size)


def test_clips_come_back_from_disk_and_are_written_once(tmp_path: Path) -> None:
    written = list(write_clips(tmp_path, always_masked(), range(2), frames=2, size=SIZE, processes=1))
    stamps = [path.stat().st_mtime_ns for path in written]
    again = list(write_clips(tmp_path, always_masked(), range(3), frames=2, size=SIZE, processes=1))
    assert again[:2] == written
    assert [path.stat().st_mtime_ns for path in written] == stamps
    assert clip_paths(tmp_path) == sorted(again)
    for seed, path in enumerate(clip_paths(tmp_path)):
        clip, stored = render_clip(seed, always_masked(), frames=2, size=SIZE), read_clip(path)
        for field in fields(clip):
            expected, observed = getattr(clip, field.name), getattr(stored, field.name)
            if field.name == "swell":
                assert (expected is None) == (observed is None)
                for mine, theirs in zip(expected or (), observed or (), strict=True):
                    np.testing.assert_array_equal(theirs, mine)
            elif field.name == "depth":
                np.testing.assert_allclose(observed, expected, rtol=5e-4)
            else:
                np.testing.assert_array_equal(observed, expected)


def test_two_processes_write_what_one_does(tmp_path: Path) -> None:
    one, two = (
        list(write_clips(tmp_path / str(n), DOMAINS["source"], range(2), frames=1, size=SIZE, processes=n))
        for n in (1, 2)
    )
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in two]


def test_a_folder_of_other_settings_is_not_mixed(tmp_path: Path) -> None:
    list(write_clips(tmp_path, DOMAINS["source"], range(1), frames=1, size=SIZE, processes=1))
    with pytest.raises(SettingsError, match="other settings"):
        list(write_clips(tmp_path, DOMAINS["source"], range(1), frames=2, size=SIZE, processes=1))


def test_damaged_clips_and_empty_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no rendered clips"):
        clip_paths(tmp_path)
    path = tmp_path / "0000000.npz"
    for content in (b"", b"PK\x03\x04 torn", b"plain text"):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match="not a rendered clip"):
            read_clip(path)


def test_a_data_set_folder_holds_the_clip_in_plain_files(tmp_path: Path) -> None:
    clip = render_clip(1, always_masked(), frames=3, size=SIZE)
    write_dataset_folder(clip, tmp_path)
    intrinsics = json.loads((tmp_path / "intrinsics.json").read_text())
    assert [intrinsics[key] for key in ("fx", "fy", "cx", "cy")] == [
        clip.intrinsics[0, 0], clip.intrinsics[1, 1], clip.intrinsics[0, 2], clip.intrinsics[1, 2]
    ]  # fmt: skip
    poses = [line.split() for line in (tmp_path / "poses.txt").read_text().splitlines() if not line.startswith("#")]
    for index, (name, *numbers) in enumerate(poses):
        assert name == f"{index:04d}.png"
        np.testing.assert_allclose(np.reshape(numbers, (4, 4)).astype(float), clip.world_from_camera[index], atol=1e-9)
        frame = cv2.imread(str(tmp_path / "frames" / name))[..., ::-1]
        np.testing.assert_array_equal(frame, clip.frames[index])
        stored = cv2.imread(str(tmp_path / "depth" / name), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        np.testing.assert_allclose(stored * intrinsics["depth_scale"], clip.depth[index], atol=0.01)
    mask = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask == 255, clip.valid.any(axis=0))


def test_the_evaluation_reads_a_data_set_folder_as_the_clip_it_was(tmp_path: Path) -> None:
    clip = render_clip(2, always_masked(), frames=2, size=SIZE)
    write_dataset_folder(clip, tmp_path)
    folder = DatasetFolder.open(tmp_path)
    assert folder.has_pose.all()
    np.testing.assert_allclose(folder.world_from_camera, clip.world_from_camera, atol=1e-9)
    np.testing.assert_array_equal(folder.image(1), clip.frames[1])
    assert folder.calibration.size == SIZE

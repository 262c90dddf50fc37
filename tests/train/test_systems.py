"""Systems by the name that the user gives: what is opened, what is refused, what is not at hand."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from made_bundle import write_video_bundle
from safetensors.torch import save_file
from torch import nn

from bathyscope.bundle import hash_file, shipped_bundle
from bathyscope.clip import Clip
from bathyscope.errors import CheckpointError, SettingsError
from bathyscope_train.model import Network, get_preset
from bathyscope_train.model.checkpoints import save_checkpoint
from bathyscope_train.systems import FrameEstimate, System, SystemOptions, Unavailable, open_system
from bathyscope_train.systems.recognition import recognise
from bathyscope_train.systems.registry import SystemName
from bathyscope_train.systems.system import SceneSystem
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES


@pytest.fixture
def clip() -> Clip:
    frames = np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3)).astype(np.uint8)
    return Clip(frames, np.arange(5) / 25.0)


def opened(text: str, options: SystemOptions | None = None) -> System:
    system = open_system(text, options)
    assert not isinstance(system, Unavailable)
    return system


def published(network: nn.Module, path: Path, prefix: str = "") -> Path:
    """A PyTorch file of the exact keys and shapes whose tensors all are one number, so that it takes no room."""
    state = network.state_dict()
    numbers = {name: torch.full((1,), 0.01 + 1e-5 * place) for place, name in enumerate(state)}
    torch.save({prefix + name: numbers[name].expand(value.shape) for name, value in state.items()}, path)
    return path


def vda(letter: str) -> VideoDepthAnything:
    with torch.device("meta"):
        return VideoDepthAnything(SIZES[letter])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vda-s", (None, "vda-s", None)),
        ("vda-s=runs/a=b.pth", ("vda-s", "runs/a=b.pth", None)),
        ("anysplat.safetensors@accumulated", (None, "anysplat.safetensors", "accumulated")),
        ("mine=a@b/weights@head", ("mine", "a@b/weights", "head")),
        ("dir/x@y", (None, "dir/x@y", None)),
        ("a/b=c.pth", (None, "a/b=c.pth", None)),
    ],
)
def test_names_are_taken_apart(text: str, expected: tuple[str | None, str, str | None]) -> None:
    name = SystemName.parse(text)
    assert (name.label, name.what, name.depth) == expected


def test_a_published_network_without_its_weights_is_a_row_without_numbers() -> None:
    system = open_system("vda-s")
    assert isinstance(system, Unavailable)
    assert system.name == "vda-s"
    assert system.reason.startswith("weights not available: video_depth_anything_vits.pth")
    assert "vda-s=FILE" in system.reason


def test_a_name_that_is_nothing_is_an_error_that_lists_what_there_is() -> None:
    with pytest.raises(SettingsError, match=r"vda-x: no such file .* constant, brightness, shipped, .* vda-l-metric"):
        open_system("vda-x")


def test_the_baselines_are_what_they_say(clip: Clip) -> None:
    constant, brightness = opened("flat=constant"), opened("brightness")
    assert (constant.info.name, constant.info.weights_sha256) == ("flat", None)
    assert [estimate.values.max() for estimate in constant.estimate(clip)] == [1.0] * len(clip)
    for frame, estimate in zip(clip.frames, brightness.estimate(clip), strict=True):
        luma = frame @ np.array([0.299, 0.587, 0.114]) / 255
        np.testing.assert_allclose(estimate.values**-2, np.maximum(luma, 1 / 255), rtol=1e-5)


def test_an_option_that_does_not_apply_is_refused() -> None:
    with pytest.raises(SettingsError, match="constant: depth 'head' does not apply to it; it takes no options"):
        open_system("constant@head")


def assert_scene(estimates: list[FrameEstimate], clip: Clip) -> None:
    assert [estimate.index for estimate in estimates] == list(range(len(clip)))
    for estimate in estimates:
        assert estimate.values.shape == clip.size
        assert estimate.world_from_camera is not None
        assert estimate.intrinsics is not None
        assert estimate.confidence is not None
    np.testing.assert_array_equal(estimates[0].world_from_camera, np.eye(4))


@pytest.mark.slow  # compiles the splatter
def test_a_bundle_runs_on_the_installed_engine(clip: Clip) -> None:
    system = opened(str(shipped_bundle()))
    assert system.info.weights_sha256 == hash_file(shipped_bundle() / "bundle.json").sha256
    assert_scene(list(system.estimate(clip)), clip)
    assert isinstance(system, SceneSystem)
    assert system.info.gaussians
    scene = system.scene(clip)
    assert len(scene.gaussians) > 1000
    assert scene.cameras.world_from_camera.shape == (len(clip), 4, 4)
    assert scene.cameras.intrinsics[0, 0, 2] == pytest.approx(clip.size[1] / 2, abs=1)
    zipped = opened("shipped@accumulated")
    assert zipped.info.details["depth"] == "accumulated"
    accumulated = next(iter(zipped.estimate(clip)))
    expected = next(iter(system.estimate(clip)))
    assert (accumulated.values <= expected.values + 1e-5).mean() > 0.9  # not divided by opacity


@pytest.mark.parametrize(
    ("scale", "unit", "expected", "factor"), [("affine", None, "disparity", 1.0), ("metric", "m", "depth", 1000.0)]
)
def test_a_bundle_of_a_video_network_says_what_its_values_are(
    tmp_path: Path, clip: Clip, *, scale: str, unit: str | None, expected: str, factor: float
) -> None:
    windows = {"length": 4, "key_places": [0, 2, 3], "blend": 2, "fit": "none" if unit else "references"}
    video = {"quantity": expected, "scale": scale, "unit": unit, "resize": {"least": [28, 28]}, "windows": windows}
    write_video_bundle(tmp_path / "bundle", video, 4, 3)
    system = opened(str(tmp_path / "bundle"))
    info = system.info
    assert (info.quantity, info.scale, info.unit) == (expected, scale, "mm" if unit else None)
    assert (info.cameras, info.confidence, info.gaussians) == (False, False, False)
    estimates = list(system.estimate(clip, np.eye(3)))
    means = [estimate.values.mean() for estimate in estimates]
    np.testing.assert_allclose(means, factor * clip.frames.mean((1, 2, 3)) / 255, rtol=0.05)
    assert {estimate.world_from_camera is None for estimate in estimates} == {True}


@pytest.mark.slow  # compiles the splatter
def test_our_own_checkpoint_runs_on_the_same_engine(tmp_path: Path, clip: Clip) -> None:
    torch.manual_seed(0)
    path = tmp_path / "tiny.safetensors"
    save_checkpoint(Network(get_preset("tiny")), path)
    system = opened(f"ours={path}")
    assert (system.info.name, system.info.cameras, system.info.quantity) == ("ours", True, "depth")
    assert system.info.weights_sha256 == hash_file(path).sha256
    assert_scene(list(system.estimate(clip)), clip)


def test_a_checkpoint_that_says_its_network_is_not_taken_for_another(tmp_path: Path) -> None:
    path = tmp_path / "tiny.safetensors"
    save_checkpoint(Network(get_preset("tiny")), path)
    with pytest.raises(CheckpointError, match="says itself which network it holds; it is no vda-s"):
        open_system(f"vda-s={path}")


@pytest.mark.parametrize("prefix", ["", "module."])
def test_published_weights_fill_video_depth_anything_key_by_key(tmp_path: Path, clip: Clip, prefix: str) -> None:
    path = published(vda("s"), tmp_path / "video_depth_anything_vits.pth", prefix)
    system = opened(str(path), SystemOptions(input_size=42))
    info = system.info
    assert (info.name, info.quantity, info.scale, info.unit) == ("vda-s", "disparity", "affine", None)
    assert (info.cameras, info.confidence, info.licence) == (False, False, "Apache-2.0")
    estimates = list(system.estimate(clip))
    assert [estimate.values.shape for estimate in estimates] == [clip.size] * len(clip)
    assert estimates[0].world_from_camera is None


@pytest.mark.parametrize(
    ("letter", "file", "name"),
    [
        ("s", "metric_video_depth_anything_vits.pth", "vda-s-metric"),
        ("b", "x.pth", "vda-b"),
        ("l", "x.pth", "vda-l"),
    ],
)
def test_video_depth_anything_is_recognised_by_its_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, letter: str, file: str, name: str
) -> None:
    seen: list[str] = []

    def keep(path: Path, name: str, options: SystemOptions) -> System:
        seen.append(name)
        return opened("constant")

    monkeypatch.setattr("bathyscope_train.systems.vda.system.open_vda", keep)
    path = published(vda(letter), tmp_path / file)
    open_system(str(path))
    open_system(f"vda-{letter}-metric={path}")
    assert seen == [name, f"vda-{letter}-metric"]
    with pytest.raises(CheckpointError, match=f"holds no endodav: its tensors are those of vda-{letter}"):
        open_system(f"endodav={path}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("pretrained.norm.weight"), "lacks 1 of 351 tensors, first pretrained.norm.weight"),
        (lambda state: state.update(extra=torch.zeros(1)), "has besides 1 of 351 tensors, first extra"),
        (
            lambda state: state.update({"pretrained.norm.weight": torch.zeros(3)}),
            r"has in another shape 1 of 351 tensors, first pretrained.norm.weight \(\(3,\), \(384,\) was needed\)",
        ),
        (
            lambda state: state.update({"pretrained.norm.weight": torch.full((384,), torch.nan)}),
            "pretrained.norm.weight holds values that are not finite",
        ),
    ],
    ids=["missing", "unknown", "shape", "nan"],
)
def test_weights_that_do_not_fit_are_named(tmp_path: Path, change: object, message: str) -> None:
    path = published(vda("s"), tmp_path / "a.pth")
    state = torch.load(path, weights_only=True)
    change(state)  # type: ignore[operator]
    torch.save(state, path)
    with pytest.raises(CheckpointError, match=message):
        open_system(str(path))


def test_weights_of_nobody_are_named(tmp_path: Path) -> None:
    save_file({"layer.weight": torch.zeros(2)}, tmp_path / "a.safetensors")
    with pytest.raises(CheckpointError, match=r"its 1 tensors \(like layer.weight\) are those of no network"):
        open_system(str(tmp_path / "a.safetensors"))


def test_files_that_hold_more_than_tensors_are_never_unpickled(tmp_path: Path) -> None:
    torch.save({"model": Path}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match="could run code"):
        open_system(str(tmp_path / "a.pth"))


def test_a_zip_that_is_neither_bundle_nor_checkpoint_is_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("hello.txt", "hello")
    with pytest.raises(CheckpointError, match="not a PyTorch checkpoint"):
        open_system(str(tmp_path / "a.zip"))


@pytest.mark.parametrize(
    ("keys", "name"),
    [
        (("aggregator.camera_token", "point_head.norm.weight"), "vggt"),
        (("aggregator.camera_token", "gaussian_param_head.norm.weight"), "anysplat"),
        (("encoder.aggregator.camera_token", "encoder.gaussian_param_head.norm.weight"), "anysplat"),
        (("model.encoder.aggregator.camera_token", "model.encoder.gaussian_param_head.norm.weight"), "anysplat"),
    ],
)
def test_anysplat_and_vggt_are_told_apart_by_the_gaussian_head(
    tmp_path: Path, keys: tuple[str, str], name: str
) -> None:
    save_file({keys[0]: torch.zeros(1, 2, 1, 1024), keys[1]: torch.zeros(2)}, tmp_path / "a.safetensors")
    kind = recognise(tmp_path / "a.safetensors")
    assert kind is not None
    assert (kind.name, kind.preset) == (name, name)


def test_a_system_goes_by_the_name_it_is_given(tmp_path: Path) -> None:
    path = published(vda("s"), tmp_path / "a.pth")
    info = opened(f"mine={path}").info
    assert (info.name, info.details["network"]) == ("mine", "vda-s")


def test_a_folder_without_weights_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"neither a bundle \(bundle.json\) nor weights"):
        open_system(str(tmp_path))

"""Video networks as bundles: graphs against PyTorch, and the engine against the system."""

from __future__ import annotations

import fcntl
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from bathyscope.bundle import Bundle
from bathyscope.clip import Clip
from bathyscope.engines import engine_factory
from bathyscope.errors import BundleError
from bathyscope.keyed_windows import KeyedWindows
from bathyscope.model_spec import ResizeSpec, VideoSpec
from bathyscope.vision.shorter_side import to_network
from bathyscope_export.attention import fused_count
from bathyscope_export.cli import app
from bathyscope_export.video_writer import ValueDifference, VideoBundleSettings, compare_video, write_video_bundle
from bathyscope_train.systems.baselines import BASELINES
from bathyscope_train.systems.endodac import DepthNetwork, DepthSettings
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES, VdaSettings
from bathyscope_train.systems.vda.system import vda_system
from bathyscope_train.systems.video_networks import VideoNetwork

SMALL = VdaSettings(
    width=16, depth=4, heads=2, taps=(0, 1, 2, 3), features=8, channels=(8, 8, 8, 16), grid=5, motion_groups=4
)
SETTINGS = VideoBundleSettings("small", "3", "0" * 64, {})
SIDE = 56

pytestmark = pytest.mark.slow  # tracing takes half a minute


def random_network() -> VideoDepthAnything:
    """Weights large enough that maps vary; fresh temporal modules would pass them as they are."""
    torch.manual_seed(0)
    network = VideoDepthAnything(SMALL).eval()
    for name, parameter in network.named_parameters():
        if parameter.ndim > 1:
            nn.init.normal_(parameter, std=1.5 / np.sqrt(parameter[0].numel()))
        elif name.endswith("output_conv2.2.bias"):
            nn.init.constant_(parameter, 3.0)
    return network


def described(network: nn.Module) -> VideoNetwork:
    spec = VideoSpec(
        quantity="disparity",
        scale="affine",
        resize=ResizeSpec(least=(SIDE, SIDE), lower_long=True),
        windows=KeyedWindows(),
    )
    return VideoNetwork("vda-s", network, spec, patch=14, follows_input=True, licence="Apache-2.0", research_only=False)


@dataclass(frozen=True)
class Exported:
    network: VideoDepthAnything
    bundle: Bundle


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    network = random_network()
    folder = tmp_path_factory.getbasetemp().parent / "small_video_bundle"
    with folder.with_suffix(".lock").open("w") as lock:  # one export for all workers
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            write_video_bundle(described(network), folder, SETTINGS)
    return Exported(network, Bundle.open(folder))


def clip(frames: int = 40, size: tuple[int, int] = (40, 60)) -> Clip:
    rng = np.random.default_rng(1)
    texture = np.kron(rng.integers(30, 220, (8, 40, 3)), np.ones((5, 3, 1)))
    shown = np.stack([texture[: size[0], t : t + size[1]] for t in range(frames)])
    return Clip(shown.astype(np.uint8), np.arange(frames) / 25.0)


def test_the_manifest_says_what_the_network_gives_and_how_close_the_graphs_are(exported: Exported) -> None:
    manifest = exported.bundle.manifest
    assert (manifest.kind, manifest.outputs, manifest.preset) == ("video", ("disparity",), "vda-s")
    assert set(manifest.graphs) == {"backbone", "heads"}
    assert manifest.training == {"weights_sha256": "0" * 64}
    compared = {(record["frames"], record["height"], record["width"]) for record in manifest.parity}
    assert {(32, 56, 70), (1, 70, 70)} <= compared  # the longest window; the size of the position table
    assert max(record["values"] for record in manifest.parity) < 1e-4


def test_attention_stays_fused(exported: Exported) -> None:
    backbone = onnx.load(exported.bundle.graph("backbone"), load_external_data=False)
    assert fused_count(backbone) == SMALL.depth + 2 * 4
    assert "Softmax" not in {node.op_type for node in backbone.graph.node}


def test_the_engine_gives_what_the_system_gives(exported: Exported) -> None:
    frames = clip()
    system = vda_system(exported.network, name="small", metric=False, input_size=SIDE)
    expected = np.stack([estimate.values for estimate in system.estimate(frames)])
    run = engine_factory()(exported.bundle).run(frames)
    found = list(run)
    assert run.meta().outputs == ("disparity",)
    assert all(frame.world_from_camera is None for frame in found)
    assert expected.std() > 0.05
    np.testing.assert_allclose(np.stack([frame.depth for frame in found]), expected, atol=2e-4 * expected.max())


def test_graphs_of_other_weights_are_told(exported: Exported) -> None:
    other = random_network()
    with torch.no_grad():
        other.head.scratch.output_conv2[2].bias.add_(0.05)
    difference = compare_video(described(other), exported.bundle.folder, exported.bundle.manifest.graphs)[0]
    assert (difference.frames, difference.height, difference.width) == (1, 84, 112)
    with pytest.raises(BundleError, match=r"differ from PyTorch on 1 frames of 84x112"):
        difference.check()


def test_a_difference_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(BundleError, match="nan"):
        ValueDifference(1, 14, 14, float("nan")).check()
    ValueDifference(1, 14, 14, 1e-5).check()


def test_a_network_of_one_size_takes_single_pictures_of_any(tmp_path: Path) -> None:
    torch.manual_seed(0)
    sizes = {"width": 16, "depth": 4, "heads": 2, "grid": 5, "features": 8, "channels": (4, 4, 8, 8)}
    settings = DepthSettings.model_validate(sizes | {"image_size": (28, 42), "adapter": None, "neck": ()})
    network = DepthNetwork(settings).eval()
    for parameter in network.parameters():
        if parameter.ndim > 1:
            nn.init.normal_(parameter, std=1.5 / np.sqrt(parameter[0].numel()))
    video = VideoNetwork(
        "endodac",
        network,
        VideoSpec(
            quantity="depth",
            scale="relative",
            resize=ResizeSpec(least=(28, 42), back="centres"),
            windows=None,
            depth_range=settings.depth_range,
        ),
        patch=14,
        follows_input=False,
        licence="none",
        research_only=True,
    )
    bundle = write_video_bundle(video, tmp_path / "bundle", SETTINGS)
    compared = {(record["height"], record["width"]) for record in bundle.manifest.parity}
    assert compared == {(84, 112), (70, 56), (56, 84)}
    frames = clip(3, (40, 60))
    depth = engine_factory()(bundle).run(frames)
    shown = np.stack([to_network(frame, (28, 42)) for frame in frames.frames])
    with torch.no_grad():
        disparity = network.finish(*network.mixed(torch.from_numpy(shown))).numpy()
    for frame, small in zip(depth, disparity, strict=True):
        resized = cv2.resize(small, (60, 40), interpolation=cv2.INTER_LINEAR)
        np.testing.assert_allclose(frame.depth, settings.depth_range.depth(resized), rtol=1e-3)


def test_the_command_tells_a_video_network_by_its_keys_and_refuses_what_it_decides_itself(tmp_path: Path) -> None:
    with torch.device("meta"):
        state = VideoDepthAnything(SIZES["s"]).state_dict()
    torch.save({name: torch.zeros(1).expand(value.shape) for name, value in state.items()}, tmp_path / "vda.pth")
    arguments = [str(tmp_path / "vda.pth"), str(tmp_path / "bundle")]
    refused = CliRunner().invoke(app, [*arguments, "--window", "16"])
    assert refused.exit_code == 2
    assert "vda-s brings its own windows, size and licence; --window cannot be given" in refused.stderr
    unknown = CliRunner().invoke(app, [*arguments, "--preset", "vda-x"])
    assert (unknown.exit_code, "no network 'vda-x'" in unknown.stderr) == (2, True)
    wrong = CliRunner().invoke(app, [*arguments, "--preset", "endodav"])
    assert (wrong.exit_code, "its tensors are those of vda-s" in wrong.stderr) == (2, True)
    assert not (tmp_path / "bundle").exists()


@pytest.mark.parametrize("name", ["constant", "brightness"])
def test_a_guess_becomes_a_bundle_by_its_name(tmp_path: Path, name: str) -> None:
    done = CliRunner().invoke(app, [name, str(tmp_path / "bundle")])
    assert done.exit_code == 0, done.stderr
    bundle = Bundle.open(tmp_path / "bundle")
    assert bundle.manifest.training == {"weights_sha256": None}
    pictures = np.random.default_rng(0).integers(0, 255, (2, 518, 518, 3)).astype(np.uint8)  # seen as they are
    frames = Clip(pictures, np.arange(2) / 25.0)
    for frame, image in zip(engine_factory()(bundle).run(frames), frames.frames, strict=True):
        np.testing.assert_allclose(frame.depth, BASELINES[name].guess(image), rtol=1e-4)

"""EndoDAV as a system: option sets from files, windows, and depth from disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from bathyscope.clip import Clip
from bathyscope.errors import CheckpointError
from bathyscope.vision.shorter_side import covering_size
from bathyscope_train.systems import open_system
from bathyscope_train.systems.endodav import EndoDav, EndoDavSettings
from bathyscope_train.systems.endodav.loading import load_endodav, start_from_vda
from bathyscope_train.systems.endodav.system import WINDOWS, EndoDavSystem, endodav_system
from bathyscope_train.systems.endodav.training import parameters, turn
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES, VdaSettings

SIZE = VdaSettings(width=16, depth=4, heads=2, taps=(0, 1, 2, 3), features=32, channels=(4, 4, 32, 32), grid=4)
SMALL = EndoDavSettings(network=SIZE, image_size=(28, 42), neck=(), head="video", temporal_adapter=True, rank=2)


def network_of(settings: EndoDavSettings = SMALL) -> EndoDav:
    torch.manual_seed(0)
    network = EndoDav(settings).eval()
    output = network.head.scratch.output_conv2[2] if settings.head == "video" else None
    if output is not None:
        torch.nn.init.constant_(output.bias, 0.5)
    return network


def clip(frames: int) -> Clip:
    images = np.random.default_rng(0).integers(0, 256, (frames, 30, 40, 3), np.uint8)
    return Clip(images, np.arange(frames) / 25)


@pytest.mark.parametrize("frames", [1, 23, 33])
def test_every_frame_comes_back_once_at_its_size(frames: int) -> None:
    system = endodav_system(network_of(), name="endodav")
    estimates = list(system.estimate(clip(frames)))
    assert [estimate.index for estimate in estimates] == list(range(frames))
    assert all(estimate.values.shape == (30, 40) for estimate in estimates)
    assert system.info.quantity == "depth"
    assert not system.info.cameras


def test_depth_of_the_first_window_is_the_formula_of_the_networks_disparity() -> None:
    network = network_of()
    system = endodav_system(network, name="endodav")
    frames = clip(32)
    inputs = np.stack([system.disparities.prepare(frame) for frame in frames.frames])
    with torch.no_grad():
        disparity = network.disparity(torch.from_numpy(inputs)[None])[0]
        at_size = torch.nn.functional.interpolate(disparity[None], (30, 40), mode="bilinear", align_corners=True)[0]
    expected = 1 / (1 / 150 + (10 - 1 / 150) * at_size.numpy())
    observed = np.stack([estimate.values for estimate in system.estimate(frames)])
    np.testing.assert_allclose(observed[:24], expected[:24], rtol=1e-4)


def test_windows_keep_other_frames_than_video_depth_anything() -> None:
    assert WINDOWS.key_places == (6, 12, 24, 25, 26, 27, 28, 29, 30, 31)
    assert (WINDOWS.length, WINDOWS.overlap, WINDOWS.stride, WINDOWS.fit) == (32, 10, 22, "blended")


@pytest.mark.parametrize(
    ("frame", "size"),
    [((1024, 1280), (224, 280)), ((288, 720), (224, 560)), ((480, 640), (224, 294)), ((100, 100), (280, 280))],
)
def test_frames_cover_the_networks_size_in_whole_patches(frame: tuple[int, int], size: tuple[int, int]) -> None:
    assert covering_size(frame, (224, 280)) == size


def test_coarser_scales_of_the_video_head_are_halved_and_rounded_down() -> None:
    with torch.no_grad():
        disparities = network_of()(torch.rand(1, 2, 3, 30, 40))
    assert [tuple(each.shape) for each in disparities] == [(2, 1, 28, 42), (2, 1, 14, 21), (2, 1, 7, 10), (2, 1, 3, 5)]


def test_a_sigmoid_output_stays_below_one() -> None:
    settings = SMALL.model_copy(update={"output": "sigmoid"})
    with torch.no_grad():
        disparity = network_of(settings).disparity(torch.rand(1, 2, 3, 30, 40))
    assert ((disparity > 0) & (disparity < 1)).all()


def test_training_starts_from_video_depth_anything(tmp_path: Path) -> None:
    torch.manual_seed(1)
    plain = VideoDepthAnything(SIZE).eval()
    torch.save(plain.state_dict(), tmp_path / "vda.pth")
    adapted = network_of(SMALL.model_copy(update={"neck": (1, 3)}))
    start_from_vda(adapted, tmp_path / "vda.pth")
    images = torch.rand(1, 3, 3, 28, 42)
    with torch.no_grad():
        torch.testing.assert_close(adapted.disparity(images), plain(images), atol=1e-5, rtol=0)


def test_training_of_the_sigmoid_head_starts_from_video_depth_anything_but_its_output(tmp_path: Path) -> None:
    plain = VideoDepthAnything(SIZE)
    torch.save(plain.state_dict(), tmp_path / "vda.pth")
    adapted = network_of(SMALL.model_copy(update={"head": "sigmoid"}))
    start_from_vda(adapted, tmp_path / "vda.pth")
    assert torch.equal(adapted.pretrained.norm.weight, plain.pretrained.norm.weight)
    assert torch.equal(adapted.head.projects[0].weight, plain.head.projects[0].weight)


def test_training_does_not_start_from_weights_of_another_size(tmp_path: Path) -> None:
    torch.save({"pretrained.norm.weight": torch.zeros(3)}, tmp_path / "vda.pth")
    with pytest.raises(CheckpointError, match="is no Video Depth Anything of width 16: it lacks"):
        start_from_vda(network_of(), tmp_path / "vda.pth")


def test_temporal_adapters_take_turns_with_spatial_ones() -> None:
    turns = [turn(SMALL, step) for step in (0, 399, 400, 499, 500)]
    assert turns == ["spatial", "spatial", "temporal", "temporal", "spatial"]
    network = network_of()
    for step, part in ((0, "pretrained."), (400, "head.motion_modules.")):
        parameters(network, step)
        trained = [name for name, value in network.named_parameters() if value.requires_grad]
        assert trained
        assert all(name.startswith(part) and name[-6:] in {"lora_A", "lora_B"} for name in trained)
    assert turn(SMALL.model_copy(update={"temporal_adapter": False}), 450) == "spatial"


def published(settings: EndoDavSettings) -> dict[str, Tensor]:
    with torch.device("meta"):
        state = EndoDav(settings).state_dict()
    return {
        key: torch.full((1,) * value.ndim, 0.01, dtype=value.dtype).expand(value.shape) for key, value in state.items()
    }


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        (EndoDavSettings(), "dvlora, neck, sigmoid head"),
        (
            EndoDavSettings(adapter="ssb", rank=1, temporal_adapter=True, neck=(), head="video"),
            "ssb, temporal ones too, no neck, video head",
        ),
    ],
    ids=["dvlora", "ssb"],
)
def test_a_published_file_opens_whatever_its_options(tmp_path: Path, settings: EndoDavSettings, options: str) -> None:
    torch.save(published(settings), tmp_path / "depth_model.pth")
    system = open_system(f"endodav={tmp_path}")
    assert isinstance(system, EndoDavSystem)
    assert system.info.details["options"] == options


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "vit-l",
            "a position table of shape .1, 257, 1024., .1, 1370, 384. was needed: EndoDAV can be used on ViT-S only",
        ),
        (
            "mixed",
            r"is no EndoDAV with dvlora, no neck, video head: it lacks 1 of 447 tensors, first pretrained.blocks.7",
        ),
        ("other", "no EndoDAV: it has 1 tensors, like encoder.x"),
    ],
)
def test_a_checkpoint_of_something_else_says_what_is_wrong(tmp_path: Path, change: str, message: str) -> None:
    tensors = published(EndoDavSettings(neck=(), head="video"))
    if change == "vit-l":
        tensors["pretrained.pos_embed"] = torch.zeros(1, 257, 1024)
    elif change == "mixed":
        del tensors["pretrained.blocks.7.mlp.fc1.lora_U"]
    else:
        tensors = {"encoder.x": torch.zeros(1)}
    torch.save(tensors, tmp_path / "depth_model.pth")
    with pytest.raises(CheckpointError, match=message):
        load_endodav(tmp_path / "depth_model.pth")


def test_plain_video_depth_anything_is_not_taken_for_it(tmp_path: Path) -> None:
    with torch.device("meta"):
        state = VideoDepthAnything(SIZES["s"]).state_dict()
    torch.save({key: torch.zeros(1).expand(value.shape) for key, value in state.items()}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match="holds no endodav: its tensors are those of vda-s"):
        open_system(f"endodav={tmp_path / 'a.pth'}")

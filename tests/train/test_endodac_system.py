"""EndoDAC as a system: its folder of weights, depth at the size of the frames, and the chain of cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from bathyscope.clip import Clip
from bathyscope.errors import CheckpointError, SettingsError
from bathyscope_train.systems import SystemOptions, open_system
from bathyscope_train.systems.endodac import DEPTH_SETTINGS, DepthNetwork, DepthSettings
from bathyscope_train.systems.endodac.loading import EndoDacNetworks, PoseNetworks, load_networks
from bathyscope_train.systems.endodac.pose import IntrinsicsHead, PoseDecoder, average_intrinsics, motion_matrix
from bathyscope_train.systems.endodac.resnet import PairEncoder
from bathyscope_train.systems.endodac.system import EndoDacSystem, endodac_system
from bathyscope_train.systems.system import System

SMALL = DepthSettings(
    width=16, depth=4, heads=2, grid=4, image_size=(56, 70), features=8, channels=(4, 4, 8, 8), rank=2, neck=(1,)
)
MOTION = torch.tensor((0.0, 0.02, 0.0, 0.1, 0.0, 0.05))


def clip(frames: int, size: tuple[int, int] = (48, 60)) -> Clip:
    images = np.random.default_rng(0).integers(0, 256, (frames, *size, 3), np.uint8)
    return Clip(images, np.arange(frames) / 25)


def depth_network(settings: DepthSettings = SMALL) -> DepthNetwork:
    torch.manual_seed(0)
    return DepthNetwork(settings).eval()


def pose_networks(*, intrinsics: bool) -> PoseNetworks:
    """Networks that see the same motion between any two frames."""
    torch.manual_seed(1)
    decoder = PoseDecoder()
    last = decoder.net[3]
    assert isinstance(last, nn.Conv2d)
    assert last.bias is not None
    nn.init.zeros_(last.weight)
    with torch.no_grad():
        last.bias[:6] = 1000 * MOTION
    return PoseNetworks(PairEncoder().eval(), decoder.eval(), IntrinsicsHead().eval() if intrinsics else None)


def test_without_pose_networks_there_is_depth_only_and_the_system_says_so() -> None:
    system = endodac_system(EndoDacNetworks(depth_network(), None), name="endodac")
    estimates = list(system.estimate(clip(3)))
    assert not system.info.cameras
    assert [estimate.index for estimate in estimates] == [0, 1, 2]
    assert all(estimate.world_from_camera is None and estimate.intrinsics is None for estimate in estimates)
    assert all(estimate.values.shape == (48, 60) and estimate.values.dtype == np.float32 for estimate in estimates)
    assert all(((estimate.values > 0.1) & (estimate.values < 150)).all() for estimate in estimates)


def test_depth_is_the_inverse_of_the_resized_scaled_disparity() -> None:
    network, frames = depth_network(), clip(1, (56, 70))
    image = torch.from_numpy(frames.frames).permute(0, 3, 1, 2).float() / 255
    with torch.no_grad():
        scaled = network.scaled_disparity(image)[0].numpy()
    expected = 1 / cv2.resize(scaled, (70, 56), interpolation=cv2.INTER_LINEAR)
    (estimate,) = endodac_system(EndoDacNetworks(network, None), name="endodac").estimate(frames)
    np.testing.assert_allclose(estimate.values, expected, rtol=1e-5)


def test_frames_do_not_depend_on_the_batch_that_they_are_in() -> None:
    system = endodac_system(EndoDacNetworks(depth_network(), None), name="endodac")
    frames = clip(10)
    together = list(system.estimate(frames))
    alone = [next(iter(system.estimate(Clip(frames.frames[i : i + 1], np.zeros(1))))) for i in (0, 7, 8, 9)]
    for index, estimate in zip((0, 7, 8, 9), alone, strict=True):
        np.testing.assert_allclose(together[index].values, estimate.values, rtol=1e-4)


def test_motions_are_chained_from_the_first_frame_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bathyscope_train.systems.endodac.system.BATCH", 2)
    networks = EndoDacNetworks(depth_network(), pose_networks(intrinsics=False))
    system = endodac_system(networks, name="endodac")
    estimates = list(system.estimate(clip(4)))
    assert system.info.cameras
    step = motion_matrix(MOTION[:3].double(), MOTION[3:].double()).numpy()
    for estimate in estimates:
        assert estimate.world_from_camera is not None
        expected = np.linalg.matrix_power(step, estimate.index)
        np.testing.assert_allclose(estimate.world_from_camera, expected, atol=1e-6)
        rotation = estimate.world_from_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-7)


def test_intrinsics_are_given_or_learnt_or_the_average() -> None:
    frames, given = clip(2), np.array([[50.0, 0, 30], [0, 51, 24], [0, 0, 1]])
    learnt = EndoDacNetworks(depth_network(), pose_networks(intrinsics=True))
    average = EndoDacNetworks(depth_network(), pose_networks(intrinsics=False))

    def intrinsics(networks: EndoDacNetworks, known: np.ndarray | None = None) -> np.ndarray:
        estimates = endodac_system(networks, name="endodac").estimate(frames, known)
        return np.stack([estimate.intrinsics for estimate in estimates if estimate.intrinsics is not None])

    np.testing.assert_array_equal(intrinsics(learnt, given), [given, given])
    np.testing.assert_allclose(intrinsics(average), [average_intrinsics((48, 60)).numpy()] * 2)
    observed = intrinsics(learnt)
    assert observed.shape == (2, 3, 3)
    assert (observed[:, 0, 0] > 0.5 * 60).all()
    assert (observed[:, 1, 1] > 0.5 * 48).all()


def test_a_clip_of_one_frame_has_a_camera() -> None:
    networks = EndoDacNetworks(depth_network(), pose_networks(intrinsics=True))
    (estimate,) = endodac_system(networks, name="endodac").estimate(clip(1))
    np.testing.assert_array_equal(estimate.world_from_camera, np.eye(4))
    assert estimate.intrinsics is not None


def published(module: nn.Module) -> dict[str, Tensor]:
    """A state dict of the format of the public files, each tensor of one value, so that the file is small."""
    return {
        key: torch.full((1,) * value.ndim, 0.001 * index, dtype=value.dtype).expand(value.shape)
        for index, (key, value) in enumerate(module.state_dict().items())
    }


def on_paper(settings: DepthSettings) -> DepthNetwork:
    with torch.device("meta"):
        return DepthNetwork(settings)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("endodac")
    torch.save({"height": 224, "width": 280, **published(on_paper(DEPTH_SETTINGS["small"]))}, path / "depth_model.pth")
    for name, make in (("pose_encoder", PairEncoder), ("pose", PoseDecoder), ("intrinsics_head", IntrinsicsHead)):
        with torch.device("meta"):
            module = make()
        torch.save(published(module), path / f"{name}.pth")
    return path


def test_the_published_folder_opens_with_its_cameras(folder: Path) -> None:
    system = open_system(str(folder))
    assert isinstance(system, EndoDacSystem)
    assert system.info.name == "endodac-s"
    assert system.info.cameras
    assert system.info.weights_sha256 is not None
    assert system.networks.depth.settings == DEPTH_SETTINGS["small"]
    state = system.networks.depth.state_dict()
    for index, (key, value) in enumerate(state.items()):
        assert (value == torch.tensor(0.001 * index, dtype=value.dtype)).all(), key


def test_the_depth_file_alone_opens_without_cameras(folder: Path) -> None:
    system = open_system(str(folder / "depth_model.pth"))
    assert isinstance(system, EndoDacSystem)
    assert not system.info.cameras


def test_half_of_the_pose_networks_is_refused(folder: Path, tmp_path: Path) -> None:
    for name in ("depth_model.pth", "pose.pth"):
        (tmp_path / name).symlink_to(folder / name)
    with pytest.raises(CheckpointError, match=r"has pose\.pth but no pose_encoder\.pth; add it for cameras, or remove"):
        open_system(str(tmp_path))


def test_options_that_do_not_apply_are_refused(folder: Path) -> None:
    with pytest.raises(SettingsError, match="input_size 518 does not apply to it; it takes device"):
        open_system(str(folder), SystemOptions(input_size=518))


def test_a_file_of_another_size_is_no_system_of_the_name_that_was_given(folder: Path) -> None:
    with pytest.raises(CheckpointError, match="holds no endodac: its tensors are those of endodac-s"):
        open_system(f"endodac={folder / 'depth_model.pth'}")


def test_weights_that_are_not_at_hand_are_named_with_their_files() -> None:
    system = open_system("endodac")
    assert not hasattr(system, "estimate")
    assert "depth_model.pth of BeileiCui/EndoDAC" in system.reason  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "lacks",
            "is no depth network of EndoDAC, width 384, dvlora: it lacks 1 of 389 tensors, first encoder.norm.bias",
        ),
        ("besides", "it has besides 1 of 389 tensors, first encoder.extra"),
        ("shape", r"it has in another shape 1 of 389 tensors, first encoder.norm.bias \(\(5,\), \(384,\) was needed\)"),
        ("width", "an encoder of width 1024; EndoDAC has 384 and 768"),
        ("other", "no depth network of EndoDAC: 1 tensors, like pretrained.x, and no encoder.pos_embed; give"),
    ],
)
def test_a_checkpoint_of_something_else_says_what_it_lacks(tmp_path: Path, change: str, message: str) -> None:
    tensors = published(on_paper(DEPTH_SETTINGS["small"]))
    if change == "lacks":
        del tensors["encoder.norm.bias"]
    elif change == "besides":
        tensors["encoder.extra"] = torch.zeros(1)
    elif change == "shape":
        tensors["encoder.norm.bias"] = torch.zeros(5)
    elif change == "width":
        tensors["encoder.pos_embed"] = torch.zeros(1, 1, 1024)
    else:
        tensors = {"pretrained.x": torch.zeros(1)}
    torch.save(tensors, tmp_path / "depth_model.pth")
    with pytest.raises(CheckpointError, match=message):
        load_networks(tmp_path)


def test_it_is_a_system() -> None:
    system: System = endodac_system(EndoDacNetworks(depth_network(), None), name="endodac")
    assert system.info.quantity == "depth"
    assert system.info.scale == "relative"

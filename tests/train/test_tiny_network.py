"""The tiny preset as a whole: sizes, any clip length and image size, who may see whom."""

import pytest
import torch

from bathyscope.errors import GeometryError
from bathyscope_train.model import Network, get_preset
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.presets import ConvStemSettings, NetworkPreset, VitSettings


@pytest.fixture(scope="module")
def network() -> Network:
    torch.manual_seed(0)
    return Network(get_preset("tiny")).eval()


def clip(frames: int, height: int = 56, width: int = 70, seed: int = 0) -> torch.Tensor:
    return torch.rand(1, frames, 3, height, width, generator=torch.Generator().manual_seed(seed))


def test_it_is_small_enough_to_ship() -> None:
    parameters = sum(each.numel() for each in Network(get_preset("tiny")).parameters())
    assert 3.0e6 < parameters < 5.0e6
    assert 4 * parameters < 40 * 2**20


def test_the_small_preset_fits_into_forty_megabytes_of_half_precision_and_runs() -> None:
    torch.manual_seed(0)
    network = Network(get_preset("small")).eval()
    parameters = sum(each.numel() for each in network.parameters())
    assert 12e6 < parameters < 20e6
    assert 2 * parameters < 40 * 2**20
    with torch.no_grad():
        prediction = network(clip(3, 42, 56))
    assert prediction.maps.depth.shape == (1, 3, 42, 56)
    assert bool(prediction.pose_encoding.isfinite().all())


@pytest.mark.parametrize(
    ("frames", "height", "width"), [(1, 112, 140), (2, 14, 14), (5, 42, 126), (9, 70, 56)], ids=str
)
@torch.no_grad()
def test_any_length_and_any_multiple_of_the_patch_size_works(
    network: Network, frames: int, height: int, width: int
) -> None:
    prediction = network(clip(frames, height, width))
    assert prediction.maps.depth.shape == (1, frames, height, width)
    assert prediction.maps.gaussians is not None
    assert prediction.maps.gaussians.shape == (1, frames, 12, height, width)
    assert prediction.pose_encoding.shape == (1, frames, 9)
    assert all(bool(each.isfinite().all()) for each in (prediction.maps.depth, prediction.pose_encoding))
    cameras = decode_cameras(prediction.pose_encoding, (height, width))
    torch.testing.assert_close(cameras.camera_from_world[0, 0], torch.eye(4), atol=1e-6, rtol=0)
    focal = cameras.intrinsics[0, :, [0, 1], [0, 1]]
    torch.testing.assert_close(focal, focal[:1, :1].expand(frames, 2))


def test_other_sizes_are_refused_with_both_sizes_named(network: Network) -> None:
    with pytest.raises(GeometryError, match=r"50x70.*14"):
        network(clip(2, 50, 70))


@torch.no_grad()
def test_dense_maps_of_a_frame_do_not_depend_on_the_other_frames_features(network: Network) -> None:
    """So a run-time may take them a few frames at a time."""
    images = clip(4)
    features = network.encode(images)
    together = network.dense(features, images)
    part = type(features)(
        taps=tuple(tap[:, 2:3] for tap in features.taps),
        camera=features.camera[:, 2:3],
        stem_maps=tuple(each[:, 2:3] for each in features.stem_maps),
    )
    alone = network.dense(part, images[:, 2:3])
    torch.testing.assert_close(alone.depth[:, 0], together.depth[:, 2])
    torch.testing.assert_close(alone.gaussians[:, 0], together.gaussians[:, 2], atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_clips_of_a_batch_do_not_see_each_other(network: Network) -> None:
    first, second = clip(3, seed=1), clip(3, seed=2)
    both = network(torch.cat([first, second]))
    torch.testing.assert_close(both.maps.depth[1:], network(second).maps.depth, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(both.pose_encoding[1:], network(second).pose_encoding, atol=1e-4, rtol=1e-3)


@torch.no_grad()
def test_lengths_of_the_cameras_follow_the_unit_of_the_depth(network: Network) -> None:
    images = clip(4)
    features = network.encode(images)
    depth = network.dense(features, images).depth
    small, large = network.cameras(features, depth), network.cameras(features, 10 * depth)
    one, ten = small.pose_encodings[-1], large.pose_encodings[-1]
    torch.testing.assert_close(ten[..., :3], 10 * one[..., :3], atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(ten[..., 3:], one[..., 3:], atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(large.depth, 10 * small.depth, atol=1e-4, rtol=1e-3)


@torch.no_grad()
def test_a_known_focal_length_is_kept_and_zero_means_unknown(network: Network) -> None:
    images = clip(4).repeat(2, 1, 1, 1, 1)
    known = decode_cameras(network(images, torch.tensor([0.0, 61.0])).pose_encoding, (56, 70)).intrinsics
    free = decode_cameras(network(images).pose_encoding, (56, 70)).intrinsics
    torch.testing.assert_close(known[1, :, 0, 0], torch.full((4,), 61.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(known[0], free[0])


@torch.no_grad()
def test_depth_is_not_corrected_before_anything_was_learnt(network: Network) -> None:
    prediction = network(clip(5))
    torch.testing.assert_close(prediction.maps.depth, prediction.single_view_depth)


def test_every_parameter_learns() -> None:
    """Through depth, Gaussians and cameras together; the fourth tap and the like would show here."""
    torch.manual_seed(0)
    network = Network(get_preset("tiny"))
    with torch.no_grad():
        readouts = (network.depth_head, network.gaussian_param_head, network.camera_head.refiner)
        for readout in (each.readout for each in readouts):
            readout.weight.normal_(std=0.1)
    prediction = network(clip(6))
    total = prediction.maps.depth.mean() + prediction.maps.confidence.mean() + prediction.pose_encoding.square().sum()
    (total + prediction.maps.gaussians.square().mean()).backward()
    silent = [name for name, each in network.named_parameters() if each.grad is None or not each.grad.any()]
    assert silent == []


def test_light_heads_without_the_stem_they_read_are_refused() -> None:
    tiny = get_preset("tiny")
    assert isinstance(tiny.stem, ConvStemSettings)
    values = tiny.model_dump() | {"stem": VitSettings(depth=1, heads=3).model_dump()}
    with pytest.raises(ValueError, match="conv stem"):
        NetworkPreset(**values)

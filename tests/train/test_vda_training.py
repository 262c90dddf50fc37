"""Video Depth Anything under the consistency losses, with cameras of another system."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bathyscope.errors import GeometryError, SettingsError
from bathyscope_train.losses.temporal import moving_edges_loss
from bathyscope_train.losses.world import world_consistency_loss
from bathyscope_train.model import Network, get_preset
from bathyscope_train.systems.camera_sources import ClipCameras, EndoDacCameras, NetworkCameras
from bathyscope_train.systems.endodac import DepthNetwork, DepthSettings
from bathyscope_train.systems.endodac.loading import EndoDacNetworks, PoseNetworks
from bathyscope_train.systems.endodac.pose import PoseDecoder, average_intrinsics
from bathyscope_train.systems.endodac.resnet import PairEncoder
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import VdaSettings
from bathyscope_train.systems.vda.training import RATES, VdaGeometry, softly_positive

SMALL = VdaSettings(
    width=16, depth=4, heads=2, taps=(0, 1, 2, 3), features=8, channels=(8, 8, 8, 16), grid=4, motion_groups=4
)
SIZE = (42, 56)


def network() -> VideoDepthAnything:
    torch.manual_seed(0)
    built = VideoDepthAnything(SMALL)
    torch.nn.init.constant_(built.head.scratch.output_conv2[2].bias, 1.0)
    return built


def images(frames: int = 4, clips: int = 2) -> Tensor:
    return torch.rand(clips, frames, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def sideways(frames: int, depth: Tensor | None, clips: int = 2) -> ClipCameras:
    """A camera that moves 0.05 to the right from frame to frame."""
    poses = torch.eye(4).repeat(clips, frames, 1, 1)
    poses[:, :, 0, 3] = 0.05 * torch.arange(frames)
    focal = torch.tensor([[50.0, 0, SIZE[1] / 2], [0, 50.0, SIZE[0] / 2], [0, 0, 1]])
    return ClipCameras(poses, focal.expand(clips, frames, 3, 3), depth)


def test_depth_takes_median_and_spread_from_the_depth_that_comes_with_the_cameras() -> None:
    known = (
        torch.rand(2, 4, *SIZE, generator=torch.Generator().manual_seed(2))
        + torch.tensor([2.0, 40.0])[:, None, None, None]
    )
    geometry = VdaGeometry(network())(images(), known=sideways(4, known))
    for clip in range(2):
        inverse, wanted = 1 / geometry.depth[clip], 1 / known[clip]
        torch.testing.assert_close(inverse.median(), wanted.median(), rtol=1e-3, atol=0)
        spread = (inverse - inverse.median()).abs().mean()
        torch.testing.assert_close(spread, (wanted - wanted.median()).abs().mean(), rtol=2e-2, atol=0)


def test_growing_all_disparity_changes_no_depth_and_no_loss() -> None:
    """The scale is fitted anew in every step: there is nothing to gain by it."""
    module = VdaGeometry(network())
    cameras = sideways(4, torch.full((2, 4, *SIZE), 3.0) + 0.2 * torch.rand(2, 4, *SIZE))
    before = module(images(), known=cameras).depth
    with torch.no_grad():
        for layer in (module.network.head.scratch.output_conv2[2],):
            layer.weight.mul_(3)
            layer.bias.mul_(3)
    torch.testing.assert_close(module(images(), known=cameras).depth, before, rtol=1e-4, atol=0)


def test_both_losses_reach_the_head_and_spare_the_frozen_encoder() -> None:
    module = VdaGeometry(network())
    module.network.pretrained.requires_grad_(False)
    cameras = sideways(4, torch.full((2, 4, *SIZE), 1.0) + 0.2 * torch.rand(2, 4, *SIZE))
    geometry = module(images(), known=cameras)
    valid = torch.ones_like(geometry.depth, dtype=torch.bool)
    arguments = (geometry.depth, geometry.intrinsics, geometry.world_from_camera, valid)
    loss = world_consistency_loss(*arguments, stride=2) + moving_edges_loss(*arguments, stride=2, scales=2)
    loss.backward()
    trained = {name for name, value in module.named_parameters() if value.grad is not None and value.grad.any()}
    assert trained
    assert all(name.startswith(tuple(RATES)) for name in trained)
    assert any("motion_modules" in name for name in trained)


def test_working_out_the_head_again_changes_neither_values_nor_gradients() -> None:
    cameras = sideways(6, torch.rand(1, 6, *SIZE) + 1, clips=1)
    gradients = []
    for recompute in (False, True):
        module = VdaGeometry(network(), recompute=recompute)
        module(images(6, 1), known=cameras).depth.log().mean().backward()
        gradients.append(torch.cat([value.grad.flatten() for value in module.parameters() if value.grad is not None]))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-7)


def test_values_are_those_of_the_network() -> None:
    module = VdaGeometry(network()).eval()
    with torch.no_grad():
        torch.testing.assert_close(module.values(images()), module.network(images()), rtol=1e-5, atol=1e-6)


def test_metric_weights_give_depth_in_the_unit_of_the_poses() -> None:
    module = VdaGeometry(network(), metric=True, units_a_metre=100.0)
    metres = module.values(images())
    torch.testing.assert_close(module(images(), known=sideways(4, None)).depth, 100 * metres)
    known = 7 * metres.detach() + 0.0
    torch.testing.assert_close(module(images(), known=sideways(4, known)).depth, 7 * metres)


def test_a_nominal_depth_stands_in_for_depth_that_is_not_there() -> None:
    module = VdaGeometry(network(), nominal_depth=60.0)
    depth = module(images(), known=sideways(4, None)).depth
    assert depth[0].median().item() == pytest.approx(60.0, rel=1e-3)
    with pytest.raises(GeometryError, match="up to scale and shift; give cameras that come with depth"):
        VdaGeometry(network())(images(), known=sideways(4, None))


def test_clips_without_cameras_are_refused() -> None:
    with pytest.raises(GeometryError, match="without cameras"):
        VdaGeometry(network())(images())


def test_pixels_outside_the_field_of_view_do_not_decide_the_fit() -> None:
    module = VdaGeometry(network())
    known = torch.full((2, 4, *SIZE), 2.0) + 0.1 * torch.rand(2, 4, *SIZE)
    inside = torch.ones(2, *SIZE, dtype=torch.bool)
    inside[:, :10] = False
    spoilt = known.clone()
    spoilt[:, :, :10] = 1e3
    torch.testing.assert_close(
        module(images(), inside, sideways(4, spoilt)).depth, module(images(), inside, sideways(4, known)).depth
    )


def test_inverse_depth_stays_positive_with_a_gradient_everywhere() -> None:
    values = torch.tensor([-5.0, 0.0, 0.2, 1.0, 3.0], requires_grad=True)
    positive = softly_positive(values, torch.tensor(1.0))
    assert (positive[1:] > 0).all()
    torch.testing.assert_close(positive[3:], values[3:].detach())
    assert positive[2].item() == pytest.approx(0.2, rel=0.01)
    positive.sum().backward()
    assert (values.grad >= 0).all()
    assert (values.grad[1:] > 0).all()


def test_cameras_of_our_network_come_with_its_depth() -> None:
    torch.manual_seed(0)
    ours = Network(get_preset("tiny")).eval()
    pictures = torch.rand(1, 3, 3, 56, 70)
    cameras = NetworkCameras(ours)(pictures)
    torch.testing.assert_close(cameras.world_from_camera[:, 0], torch.eye(4)[None], atol=1e-5, rtol=0)
    assert cameras.depth is not None
    assert cameras.depth.shape == (1, 3, 56, 70)
    geometry = VdaGeometry(network(), NetworkCameras(ours))(pictures)
    assert geometry.depth[0].median().item() == pytest.approx(cameras.depth[0].median().item(), rel=1e-3)


def test_cameras_of_the_pose_networks_are_a_chain_of_motions() -> None:
    torch.manual_seed(0)
    sizes = {"width": 16, "depth": 4, "heads": 2, "grid": 5, "features": 8, "channels": (4, 4, 8, 8)}
    settings = DepthSettings.model_validate(sizes | {"image_size": (28, 42), "adapter": None, "neck": ()})
    pose = PoseNetworks(PairEncoder().eval(), PoseDecoder().eval(), None)
    with torch.no_grad():
        pose.decoder.net[-1].bias.normal_(std=3.0)  # motions that show: the output is scaled by a thousandth
    networks = EndoDacNetworks(DepthNetwork(settings).eval(), pose)
    pictures = images(3, 1)
    whole = EndoDacCameras(networks)(pictures)
    first, second = EndoDacCameras(networks)(pictures[:, :2]), EndoDacCameras(networks)(pictures[:, 1:])
    torch.testing.assert_close(
        whole.world_from_camera[:, 2], first.world_from_camera[:, 1] @ second.world_from_camera[:, 1]
    )
    assert (whole.world_from_camera[:, 1] - torch.eye(4)).abs().max() > 1e-4
    torch.testing.assert_close(whole.intrinsics[0, 0], average_intrinsics(SIZE))
    with pytest.raises(SettingsError, match=r"without pose_encoder.pth and pose.pth has no cameras"):
        EndoDacCameras(EndoDacNetworks(networks.depth, None))

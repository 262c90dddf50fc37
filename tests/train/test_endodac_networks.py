"""EndoDAC's networks for motion, intrinsics and flow, with weights whose answers are known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bathyscope_train.systems.endodac.flow_decoder import AppearanceDecoder, FlowDecoder, UNetDecoder
from bathyscope_train.systems.endodac.pose import (
    IntrinsicsHead,
    PoseDecoder,
    average_intrinsics,
    motion_matrix,
)
from bathyscope_train.systems.endodac.resnet import CHANNELS, BasicBlock, PairEncoder
from bathyscope_train.systems.endodac.training import TrainingNetworks


def test_features_halve_in_size_five_times() -> None:
    features = PairEncoder().eval()(torch.zeros(1, 3, 64, 96), torch.zeros(1, 3, 64, 96))
    assert [tuple(maps.shape[1:]) for maps in features] == [
        (channels, 64 // 2 ** (level + 1), 96 // 2 ** (level + 1)) for level, channels in enumerate(CHANNELS)
    ]


def test_a_block_whose_second_norm_is_zero_passes_the_positive_part_of_its_input() -> None:
    block = BasicBlock(4, 4, stride=1).eval()
    nn.init.zeros_(block.bn2.weight)
    maps = torch.randn(1, 4, 5, 6)
    torch.testing.assert_close(block(maps), F.relu(maps))


def test_the_pair_is_stacked_source_first() -> None:
    encoder = PairEncoder().eval()
    with torch.no_grad():
        encoder.encoder.conv1.weight[:, 3:] = 0
    first, second, other = (torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(i)) for i in range(3))
    with torch.no_grad():
        assert torch.equal(encoder(first, second)[0], encoder(first, other)[0])
        assert not torch.equal(encoder(first, second)[0], encoder(other, second)[0])


def constant_decoder(numbers: Tensor) -> PoseDecoder:
    decoder = PoseDecoder()
    last = decoder.net[3]
    assert isinstance(last, nn.Conv2d)
    assert last.bias is not None
    nn.init.zeros_(last.weight)
    with torch.no_grad():
        last.bias.copy_(numbers)
    return decoder


def test_a_motion_is_a_thousandth_of_the_first_six_numbers() -> None:
    motion = constant_decoder(torch.arange(12.0))(torch.rand(2, 512, 3, 4))
    torch.testing.assert_close(motion.axis_angle, 1e-3 * torch.tensor([[0.0, 1.0, 2.0]] * 2))
    torch.testing.assert_close(motion.translation, 1e-3 * torch.tensor([[3.0, 4.0, 5.0]] * 2))
    assert motion.features.shape == (2, 256, 3, 4)
    assert (motion.features < 0).any()


def test_a_matrix_rotates_and_then_translates() -> None:
    quarter = motion_matrix(torch.tensor([[0.0, 0.0, math.pi / 2]]), torch.tensor([[1.0, 2.0, 3.0]]))
    moved = quarter @ torch.tensor([1.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(moved, torch.tensor([[1.0, 3.0, 3.0, 1.0]]), atol=1e-5, rtol=0)


def test_intrinsics_of_a_silent_head_are_those_of_the_activations() -> None:
    head = IntrinsicsHead()
    nn.init.zeros_(head.focal_length_conv.weight)
    nn.init.zeros_(head.offsets_conv.weight)
    focal = math.log(2) + 0.5
    expected = torch.tensor([[[focal * 320, 0.0, 160.0], [0.0, focal * 256, 128.0], [0.0, 0.0, 1.0]]])
    torch.testing.assert_close(head(torch.randn(1, 256, 3, 4), (256, 320)), expected)


def test_intrinsics_follow_the_mean_of_the_features() -> None:
    head = IntrinsicsHead()
    nn.init.constant_(head.focal_length_conv.weight, 1 / 256)
    nn.init.constant_(head.offsets_conv.weight, -1 / 256)
    matrix = head(torch.full((1, 256, 2, 2), 0.1), (100, 200))[0]
    focal = math.log1p(math.exp(0.1)) + 0.5
    expected = torch.tensor([[focal * 200, 0.0, 80.0], [0.0, focal * 100, 40.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(matrix, expected)


def test_average_intrinsics_are_published_shares_of_the_size() -> None:
    expected = torch.tensor([[1049.6, 0.0, 640.0], [0.0, 1044.48, 512.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(average_intrinsics((1024, 1280)), expected)


@pytest.mark.parametrize(("decoder", "channels"), [(FlowDecoder, 2), (AppearanceDecoder, 3)])
def test_decoders_give_maps_at_four_scales(decoder: type[UNetDecoder], channels: int) -> None:
    features = PairEncoder().eval()(torch.rand(1, 3, 64, 96), torch.rand(1, 3, 64, 96))
    maps = decoder()(features)  # type: ignore[call-arg]
    assert [tuple(each.shape) for each in maps] == [(1, channels, 64 // 2**k, 96 // 2**k) for k in range(4)]
    if decoder is AppearanceDecoder:
        assert all((each.abs() < 1).all() for each in maps)


def test_a_fresh_flow_is_next_to_none() -> None:
    features = [torch.rand(1, channels, 64 // 2**k, 64 // 2**k) for k, channels in enumerate(CHANNELS)]
    assert all((maps.abs() < 0.01).all() for maps in FlowDecoder()(features))


def test_the_two_optimisers_share_no_parameter_and_leave_out_what_is_never_read() -> None:
    with torch.device("meta"):
        networks = TrainingNetworks()
    flow = {id(value) for value in networks.flow_parameters()}
    scene = {id(value) for value in networks.scene_parameters()}
    assert not flow & scene
    left = {name for name, value in networks.named_parameters() if id(value) not in flow | scene}
    assert {name.split(".", 1)[1] for name in left} == {
        "encoder.fc.weight",
        "encoder.fc.bias",
        "convs_suqeeze.weight",
        "convs_suqeeze.bias",
    }

"""What systems on Depth Anything share: positions, taps, necks, the trunk of the head, and disparity to depth."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from bathyscope.depth_range import DepthRange
from bathyscope.errors import GeometryError
from bathyscope_train.systems.depth_anything.disparity import SigmoidPyramid
from bathyscope_train.systems.depth_anything.encoder import Encoder
from bathyscope_train.systems.depth_anything.neck import NeckBlock, add_necks
from bathyscope_train.systems.depth_anything.positions import resized_positions
from bathyscope_train.systems.depth_anything.pyramid import Pyramid


def small_encoder(grid: int = 4) -> Encoder:
    torch.manual_seed(0)
    return Encoder(width=16, depth=5, heads=2, taps=(1, 2, 3, 4), grid=grid).eval()


@pytest.mark.parametrize("size", [(16, 20), (37, 46), (5, 5)], ids=str)
def test_positions_are_those_of_torch_with_the_factor_given(size: tuple[int, int]) -> None:
    table = torch.randn(1, 1 + 37 * 37, 6, generator=torch.Generator().manual_seed(0))
    square = table[:, 1:].unflatten(1, (37, 37)).permute(0, 3, 1, 2)
    factor = ((size[0] + 0.1) / 37, (size[1] + 0.1) / 37)
    expected = F.interpolate(square, scale_factor=factor, mode="bicubic").flatten(2).transpose(1, 2)
    observed = resized_positions(table, 37, size)
    torch.testing.assert_close(observed[:, 1:], expected, atol=5e-6, rtol=0)
    assert torch.equal(observed[:, :1], table[:, :1])


def test_positions_of_the_learnt_grid_are_kept_bit_by_bit() -> None:
    table = torch.randn(1, 1 + 16, 6)
    assert torch.equal(resized_positions(table, 4, (4, 4)), table)
    assert not torch.equal(resized_positions(table, 4, (2, 8))[:, 1:], table[:, 1:])


def test_taps_are_normed_patch_tokens_of_the_named_blocks() -> None:
    encoder = small_encoder()
    images = torch.randn(2, 3, 28, 42)
    tokens = encoder.tokens_in(images)
    expected = []
    with torch.no_grad():
        for block in encoder.blocks:
            tokens = block(tokens)
            expected.append(encoder.norm(tokens)[:, 1:])
        observed = encoder(images)
    for each, tap in zip(observed, (1, 2, 3, 4), strict=True):
        torch.testing.assert_close(each, expected[tap])


def test_images_that_do_not_divide_into_patches_are_refused() -> None:
    with pytest.raises(GeometryError, match="30x42 do not divide into patches of 14"):
        small_encoder()(torch.zeros(1, 3, 30, 42))


def test_a_fresh_neck_changes_nothing_and_a_trained_one_leaves_the_class_token() -> None:
    plain, necked = small_encoder(), small_encoder()
    add_necks(necked.blocks, (1, 3), grid=(2, 3))
    assert [type(block) is NeckBlock for block in necked.blocks] == [False, True, False, True, False]
    missing, unexpected = necked.load_state_dict(plain.state_dict(), strict=False)
    assert not unexpected
    assert all(".residual_." in name for name in missing)
    images = torch.randn(1, 3, 28, 42)
    with torch.no_grad():
        for observed, expected in zip(necked(images), plain(images), strict=True):
            torch.testing.assert_close(observed, expected)
        neck = necked.blocks[1]
        assert isinstance(neck, NeckBlock)
        neck.residual_.norm3.weight.fill_(1.0)
        tokens = necked.tokens_in(images)
        changed, unchanged = neck(tokens), plain.blocks[1](tokens)
    assert torch.equal(changed[:, 0], unchanged[:, 0])
    assert (changed[:, 1:] - unchanged[:, 1:]).abs().max() > 0.1


def test_a_neck_refuses_another_grid_than_it_was_built_for() -> None:
    encoder = small_encoder()
    add_necks(encoder.blocks, (0,), grid=(2, 3))
    with pytest.raises(GeometryError, match="built for 2x3 patches, got 4 tokens; resize"):
        encoder(torch.zeros(1, 3, 28, 28))


def test_paths_have_the_sizes_that_levels_ask_for() -> None:
    pyramid = Pyramid(16, features=8, channels=(4, 4, 8, 8))
    taps = [torch.randn(2, 15, 16) for _ in range(4)]
    places: list[tuple[int, tuple[int, ...]]] = []

    def between(place: int, maps: torch.Tensor) -> torch.Tensor:
        places.append((place, tuple(maps.shape)))
        return maps

    paths = pyramid.paths(taps, (3, 5), between)
    assert [tuple(path.shape) for path in paths] == [(2, 8, 24, 40), (2, 8, 12, 20), (2, 8, 6, 10), (2, 8, 3, 5)]
    assert places == [(0, (2, 8, 3, 5)), (1, (2, 8, 2, 3)), (2, (2, 8, 3, 5)), (3, (2, 8, 6, 10))]


def test_sigmoid_disparities_halve_in_size_and_lie_between_0_and_1() -> None:
    head = SigmoidPyramid(16, features=8, channels=(4, 4, 8, 8))
    disparities = head([torch.randn(1, 6, 16) for _ in range(4)], (2, 3))
    assert [tuple(each.shape[-2:]) for each in disparities] == [(32, 48), (16, 24), (8, 12), (4, 6)]
    assert all(((each > 0) & (each < 1)).all() for each in disparities)


def test_disparity_0_is_the_farthest_depth_1_the_nearest_and_more_is_nearer() -> None:
    depth = DepthRange().depth(torch.tensor([0.0, 1.0, 2.0]))
    torch.testing.assert_close(depth, torch.tensor([150.0, 0.1, 1 / (2 * (10 - 1 / 150) + 1 / 150)]))
    assert DepthRange(nearest=1, farthest=4).depth(torch.tensor([0.5])).item() == pytest.approx(1 / 0.625)

"""Structure of the network: what may see what, what is kept, and attention against its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError
from torch import Tensor

from bathyscope.errors import GeometryError, SettingsError
from bathyscope_train.model import Network, NetworkPreset, get_preset
from bathyscope_train.model.attention import attend
from bathyscope_train.model.presets import (
    PRESETS,
    AggregatorSettings,
    DptSettings,
    IterativeCameraSettings,
    VitSettings,
)
from bathyscope_train.model.resizing import resize_bicubic_antialiased
from bathyscope_train.model.rope import grid_positions, rope_tables, rotate

SMALL = NetworkPreset(
    name="small",
    stem=VitSettings(depth=1, heads=2, grid=3),
    aggregator=AggregatorSettings(width=16, depth=5, heads=2, layer_scale=1.0, taps=(0, 1, 2, 3)),
    camera=IterativeCameraSettings(depth=1, heads=2, layer_scale=1.0),
    depth=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    gaussians=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    harmonic_degree=1,
)


def small_network() -> Network:
    torch.manual_seed(0)
    network = Network(SMALL).eval()
    for name, parameter in network.named_parameters():
        if "token" in name:  # they start so near zero that frames would look alike
            torch.nn.init.normal_(parameter)
    return network


def clip(frames: int = 3, size: tuple[int, int] = (28, 42)) -> Tensor:
    return torch.rand(1, frames, 3, *size, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def test_all_frames_but_the_first_are_a_set() -> None:
    network, images = small_network(), clip(4)
    order = [0, 3, 1, 2]
    straight, shuffled = network(images), network(images[:, order])
    torch.testing.assert_close(shuffled.maps.depth, straight.maps.depth[:, order], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(shuffled.pose_encoding, straight.pose_encoding[:, order], rtol=1e-4, atol=1e-5)
    swapped = network(images[:, [1, 0, 2, 3]]).pose_encoding[:, [1, 0, 2, 3]]
    assert not torch.allclose(swapped, straight.pose_encoding, atol=1e-3)


@torch.no_grad()
def test_every_frame_hears_of_every_other() -> None:
    network, images = small_network(), clip()
    changed = images.clone()
    changed[:, 2] = 1 - changed[:, 2]
    difference = (network(images).maps.depth - network(changed).maps.depth).abs().amax((-1, -2))
    assert (difference > 1e-5).all()


@torch.no_grad()
def test_dense_heads_can_run_in_chunks_of_frames() -> None:
    network, images = small_network(), clip()
    features = network.encode(images)
    whole = network.dense(features, images)
    for frame in range(3):
        part = slice(frame, frame + 1)
        chunk = type(features)(
            taps=tuple(tokens[:, part] for tokens in features.taps),
            camera=features.camera[:, part],
            stem_maps=tuple(each[:, part] for each in features.stem_maps),
        )
        maps = network.dense(chunk, images[:, part])
        torch.testing.assert_close(maps.depth, whole.depth[:, part], rtol=1e-5, atol=1e-6)
        assert maps.gaussians is not None
        assert whole.gaussians is not None
        torch.testing.assert_close(maps.gaussians, whole.gaussians[:, part], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_clips_of_a_batch_do_not_see_each_other() -> None:
    network, images = small_network(), torch.cat((clip(), 1 - clip()))
    together = network(images)
    for b in range(2):
        alone = network(images[b : b + 1])
        torch.testing.assert_close(together.pose_encoding[b], alone.pose_encoding[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(together.maps.depth[b], alone.maps.depth[0], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_only_the_layers_that_heads_read_are_kept() -> None:
    layers = small_network().aggregator(clip()).layers
    assert set(layers) == {0, 1, 2, 3, 4}
    preset = SMALL.model_copy(update={"aggregator": SMALL.aggregator.model_copy(update={"taps": (0, 2, 3, 4)})})
    assert set(Network(preset).aggregator(clip()).layers) == {0, 2, 3, 4}


@torch.no_grad()
def test_heads_stay_in_float32_under_autocast() -> None:
    network, images = small_network(), clip(2)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = network(images)
    assert prediction.pose_encoding.dtype == torch.float32
    assert prediction.maps.depth.dtype == torch.float32
    assert prediction.maps.gaussians is not None
    assert prediction.maps.gaussians.dtype == torch.float32


def test_images_that_do_not_divide_into_patches_are_refused() -> None:
    with pytest.raises(GeometryError, match="30x42 do not divide into patches of 14"):
        small_network()(torch.rand(1, 2, 3, 30, 42))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_build_and_read_back_from_json(name: str) -> None:
    preset = get_preset(name)
    assert NetworkPreset.model_validate_json(preset.model_dump_json()) == preset
    with torch.device("meta"):
        Network(preset)


def test_unknown_presets_and_impossible_sizes_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"no preset 'huge'; built-in presets are anysplat"):
        get_preset("huge")
    with pytest.raises(ValidationError, match="must be a multiple of 4 a head"):
        AggregatorSettings(width=100, heads=16)
    with pytest.raises(ValidationError, match="stay below the depth of 24 pairs"):
        AggregatorSettings(taps=(1, 2, 3, 24))


def test_attention_is_the_softmax_of_scaled_products() -> None:
    queries, keys, values = torch.randn(3, 2, 7, 3, 8, generator=torch.Generator().manual_seed(0))
    scores = torch.einsum("bnhd,bmhd->bhnm", queries, keys) / 8**0.5
    expected = torch.einsum("bhnm,bmhd->bnhd", scores.softmax(-1), values).flatten(2)
    torch.testing.assert_close(attend(queries, keys, values), expected)


def test_rotary_products_depend_on_relative_positions_only() -> None:
    generator = torch.Generator().manual_seed(0)
    query, key = torch.randn(2, 1, 1, 1, 16, generator=generator)

    def product(a: tuple[int, int], b: tuple[int, int]) -> Tensor:
        turned = [
            rotate(token, rope_tables(torch.tensor([position]).float(), 16))
            for token, position in ((query, a), (key, b))
        ]
        return (turned[0] * turned[1]).sum()

    torch.testing.assert_close(product((3, 1), (5, 4)), product((10, 7), (12, 10)), rtol=1e-4, atol=1e-5)
    assert not torch.allclose(product((3, 1), (5, 4)), product((3, 1), (4, 5)), atol=1e-3)


def test_special_tokens_are_not_rotated_and_patches_start_at_one() -> None:
    positions = grid_positions(2, 3, 2, device=torch.device("cpu"))
    assert positions.tolist() == [[0, 0], [0, 0], [1, 1], [1, 2], [1, 3], [2, 1], [2, 2], [2, 3]]
    tokens = torch.randn(1, 8, 1, 8, generator=torch.Generator().manual_seed(0))
    turned = rotate(tokens, rope_tables(positions, 8))
    torch.testing.assert_close(turned[:, :2], tokens[:, :2])
    torch.testing.assert_close(turned.norm(dim=-1), tokens.norm(dim=-1))


@pytest.mark.parametrize("size", [(5, 5), (3, 9), (16, 20), (7, 1), (9, 7)])
def test_bicubic_resizing_matches_pillow(size: tuple[int, int]) -> None:
    maps = torch.randn(9, 7, generator=torch.Generator().manual_seed(0))
    picture = Image.fromarray(maps.numpy()).resize((size[1], size[0]), Image.Resampling.BICUBIC)
    observed = resize_bicubic_antialiased(maps[None, None], size)[0, 0]
    np.testing.assert_allclose(observed, np.asarray(picture), rtol=1e-4, atol=1e-5)


def test_gradients_reach_every_trained_parameter() -> None:
    network = small_network()
    prediction = network(clip(2))
    assert prediction.maps.gaussians is not None
    total = prediction.pose_encodings.sum() + prediction.maps.depth.sum() + prediction.maps.confidence.sum()
    (total + prediction.maps.gaussians.sum()).backward()
    silent = [name for name, p in network.named_parameters() if p.requires_grad and p.grad is None]
    assert silent == []

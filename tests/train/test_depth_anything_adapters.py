"""Adapters: their equations, their start, merging, and which parameters train when."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from bathyscope_train.systems.depth_anything.adapters import (
    AdaptedLinear,
    AdapterKind,
    DvLoraLinear,
    LoraLinear,
    ScaledLinear,
    adapt,
    adapted,
    adapter_parameters,
    merge_adapters,
)
from bathyscope_train.systems.depth_anything.schedule import adapter_letters, train_only

KINDS: tuple[AdapterKind, ...] = ("lora", "dvlora", "ssb")
every_kind = pytest.mark.parametrize("kind", KINDS)


def randomised(layer: nn.Module, seed: int = 0) -> nn.Module:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in layer.parameters():
            value.copy_(torch.randn(value.shape, generator=generator))
    return layer


def by_definition(layer: AdaptedLinear, x: Tensor) -> Tensor:
    """The published equations, with the diagonal matrices written out."""
    if isinstance(layer, ScaledLinear):
        weight = torch.diag(layer.lora_B[:, 0]) @ layer.weight @ torch.diag(layer.lora_A[:, 0])
        return x @ weight.T + layer.bias
    assert isinstance(layer, LoraLinear)
    down, up = layer.lora_A, layer.lora_B
    if isinstance(layer, DvLoraLinear):
        down, up = torch.diag(layer.lora_U[:, 0]) @ down, torch.diag(layer.lora_V[:, 0]) @ up
    return x @ layer.weight.T + layer.bias + layer.scale * x @ down.T @ up.T


@every_kind
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_outputs_follow_the_equation_and_stay_when_merged(kind: AdapterKind, scale: float) -> None:
    layer = randomised(adapted(nn.Linear(7, 5), kind, rank=3, scale=scale))
    assert isinstance(layer, AdaptedLinear)
    x = torch.randn(2, 4, 7, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(layer(x), by_definition(layer, x), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(layer.merged()(x), layer(x), atol=1e-5, rtol=1e-5)


@every_kind
def test_a_fresh_adapter_is_the_layer_that_it_adapts(kind: AdapterKind) -> None:
    plain = nn.Linear(7, 5)
    x = torch.randn(3, 7)
    torch.testing.assert_close(adapted(plain, kind)(x), plain(x), atol=1e-6, rtol=0)


def test_only_named_layers_are_adapted_and_merging_leaves_the_original_alone() -> None:
    network = nn.ModuleDict({"mlp": nn.ModuleDict({"fc1": nn.Linear(4, 4)}), "proj": nn.Linear(4, 4)})
    adapt(network, ("mlp.fc1",), "dvlora", rank=2)
    randomised(network)
    merged = merge_adapters(network)
    assert {name for name in network.state_dict() if "lora" in name} == {f"mlp.fc1.lora_{letter}" for letter in "ABUV"}
    assert sorted(merged.state_dict()) == ["mlp.fc1.bias", "mlp.fc1.weight", "proj.bias", "proj.weight"]
    assert type(network["mlp"]["fc1"]) is DvLoraLinear
    assert type(merged["mlp"]["fc1"]) is nn.Linear


def test_dvlora_trains_its_matrices_first_and_its_scales_afterwards() -> None:
    layer = adapted(nn.Linear(4, 3), "dvlora", rank=2)
    phases = [adapter_letters("dvlora", step, warm_up=10) for step in (0, 9, 10, 500)]
    assert phases == ["AB", "AB", "UV", "UV"]
    for letters, names in (("AB", {"lora_A", "lora_B"}), ("UV", {"lora_U", "lora_V"})):
        train_only([layer], adapter_parameters(layer, letters))
        assert {name for name, value in layer.named_parameters() if value.requires_grad} == names


@pytest.mark.parametrize(("kind", "letters"), [("lora", "AB"), ("ssb", "AB"), (None, "")])
def test_other_adapters_know_one_phase(kind: AdapterKind | None, letters: str) -> None:
    assert adapter_letters(kind, 0) == adapter_letters(kind, 10**6) == letters


@every_kind
def test_training_an_adapter_moves_the_output_and_not_the_weight(kind: AdapterKind) -> None:
    torch.manual_seed(0)
    layer = adapted(nn.Linear(4, 3), kind, rank=2)
    weight, x = layer.weight.detach().clone(), torch.randn(8, 4)
    before = layer(x).detach()
    optimiser = torch.optim.SGD(train_only([layer], adapter_parameters(layer)), lr=0.1)
    layer(x).square().mean().backward()
    optimiser.step()
    assert torch.equal(layer.weight, weight)
    assert layer(x).square().mean() < before.square().mean()

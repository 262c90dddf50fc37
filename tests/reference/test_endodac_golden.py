"""EndoDAC's depth network against runs of the published implementation (every folder of ``endodac/`` with a config)."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from bathyscope.depth_range import DepthRange
from bathyscope_train.systems.endodac import DepthNetwork, DepthSettings

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted(path.parent for path in (REFERENCE / "endodac").glob("*/config.json"))
TOLERANCE = 1e-4

pytestmark = pytest.mark.skipif(not CASES, reason=f"no endodac/*/config.json under {REFERENCE}")
every_case = pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)


@dataclass(frozen=True)
class Run:
    """One case: what was asked, what the published network computed on the way and said."""

    network: DepthNetwork
    arrays: dict[str, np.ndarray]
    observed: dict[str, Tensor]
    """What our modules gave, by their names in the checkpoint."""
    disparities: tuple[Tensor, ...]


def settings_of(folder: Path) -> DepthSettings:
    config = json.loads((folder / "config.json").read_text())
    lora = config.get("lora_type")
    return DepthSettings(
        width=config["embed_dim"],
        depth=config["depth"],
        heads=config["num_heads"],
        grid=config["pos_grid"],
        image_size=tuple(config["image_shape"]),
        features=config["features"],
        channels=tuple(config["out_channels"]),
        adapter=None if lora in (None, "none") else lora,
        rank=config["r"],
        neck=tuple(config.get("residual_block_indexes", ())),
        depth_range=DepthRange(nearest=config["min_depth"], farthest=config["max_depth"]),
    )


@cache
def run(folder: Path) -> Run:
    network = DepthNetwork(settings_of(folder)).eval()
    network.load_state_dict(load_file(folder / "weights.safetensors"))
    with np.load(folder / "forward.npz") as file:
        arrays = dict(file)
    observed: dict[str, Tensor] = {}
    names = [key.removeprefix("inter_") for key in arrays if key.startswith("inter_") and key != "inter_tokens_in"]

    def keep(name: str) -> object:
        def hook(_: nn.Module, __: object, output: Tensor) -> None:
            observed[name] = output

        return hook

    for name in names:
        network.get_submodule(name).register_forward_hook(keep(name))
    with torch.no_grad():
        network.encoder.blocks[0].register_forward_pre_hook(lambda _, inputs: observed.update(tokens_in=inputs[0]))
        disparities = network(torch.from_numpy(arrays["image"]))
    return Run(network, arrays, observed, disparities)


def assert_close(observed: Tensor, expected: np.ndarray) -> None:
    assert observed.shape == expected.shape
    assert np.abs(observed.numpy() - expected).max() <= TOLERANCE * np.abs(expected).max()


@every_case
def test_intermediate_maps_match(folder: Path) -> None:
    case = run(folder)
    names = [key for key in case.arrays if key.startswith("inter_")]
    assert names
    for name in names:
        assert_close(case.observed[name.removeprefix("inter_")], case.arrays[name])


@every_case
def test_disparities_of_all_scales_match(folder: Path) -> None:
    case = run(folder)
    for scale in range(4):
        assert_close(case.disparities[scale], case.arrays[f"disp_{scale}"])


@every_case
def test_depth_of_the_finest_scale_matches(folder: Path) -> None:
    case = run(folder)
    image = torch.from_numpy(case.arrays["image"])
    with torch.no_grad():
        assert_close(case.network.scaled_disparity(image), case.arrays["scaled_disp_0"][:, 0])
        assert_close(case.network.depth(image), case.arrays["depth_0"][:, 0])


@every_case
def test_merging_leaves_no_adapter_and_the_same_disparities(folder: Path) -> None:
    case = run(folder)
    merged = case.network.merge()
    assert not any("lora" in name for name in merged.state_dict())
    with torch.no_grad():
        for observed, expected in zip(merged(torch.from_numpy(case.arrays["image"])), case.disparities, strict=True):
            torch.testing.assert_close(observed, expected, atol=1e-5, rtol=0)


@every_case
def test_the_two_stages_of_an_exported_network_give_the_finest_disparity(folder: Path) -> None:
    case = run(folder)
    with torch.no_grad():
        maps = case.network.mixed(torch.from_numpy(case.arrays["image"]))
        alone = [case.network.finish(*(each[i : i + 1] for each in maps)) for i in range(len(maps[0]))]
    assert_close(torch.cat(alone), case.arrays["disp_0"][:, 0])

"""Names, shapes and kinds of the parameters of EndoDAC's networks against the lists of the published checkpoints."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from bathyscope_train.systems.endodac import DEPTH_SETTINGS, DepthNetwork
from bathyscope_train.systems.endodac.flow_decoder import AppearanceDecoder, FlowDecoder
from bathyscope_train.systems.endodac.pose import IntrinsicsHead, PoseDecoder
from bathyscope_train.systems.endodac.resnet import PairEncoder

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
Entry = tuple[tuple[int, ...], str]

NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "depth_base": lambda: DepthNetwork(DEPTH_SETTINGS["base"]),
    "depth_small": lambda: DepthNetwork(DEPTH_SETTINGS["small"]),
    "pose_encoder": PairEncoder,
    "pose": PoseDecoder,
    "intrinsics_head": IntrinsicsHead,
    "position": FlowDecoder,
    "transform": AppearanceDecoder,
}


def listed(path: Path) -> dict[str, Entry]:
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {row["key"]: (sides(row["shape"]), row["dtype"]) for row in rows}


def sides(shape: str) -> tuple[int, ...]:
    return () if shape == "scalar" else tuple(int(side) for side in shape.split("x"))


def built(make: Callable[[], nn.Module]) -> dict[str, Entry]:
    with torch.device("meta"):
        network = make()
    return {
        key: (tuple(value.shape), str(value.dtype).removeprefix("torch."))
        for key, value in network.state_dict().items()
    }


@pytest.mark.parametrize("name", NETWORKS)
def test_keys_shapes_and_kinds_are_the_published_ones(name: str) -> None:
    expected = listed(REFERENCE / "endodac" / f"state_dict_{name}.tsv")
    assert built(NETWORKS[name]) == expected


@pytest.mark.parametrize(("name", "parameters"), [("depth_base", 99_091_748), ("depth_small", 25_310_020)])
def test_depth_networks_have_the_published_number_of_parameters(name: str, parameters: int) -> None:
    assert sum(torch.Size(shape).numel() for shape, _ in built(NETWORKS[name]).values()) == parameters

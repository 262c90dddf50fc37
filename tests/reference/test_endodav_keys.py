"""Names, shapes and numbers of EndoDAV's parameters against the lists of the published option sets."""

from __future__ import annotations

import csv
import os
from functools import cache
from pathlib import Path

import pytest
import torch

from bathyscope_train.model.weight_files import WeightFile
from bathyscope_train.systems.endodac import DEPTH_SETTINGS, DepthNetwork
from bathyscope_train.systems.endodac.training import depth_parameters
from bathyscope_train.systems.endodav import EndoDav, EndoDavSettings
from bathyscope_train.systems.endodav.loading import settings_of
from bathyscope_train.systems.endodav.training import parameters

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
Entry = tuple[tuple[int, ...], str]

OPTION_SETS = {
    "vits_ssb_tlora_nores_vdahead": (
        EndoDavSettings(adapter="ssb", rank=1, temporal_adapter=True, neck=(), head="video"),
        (29_084_737, 46_080),
    ),
    "vits_dvlora_nores_vdahead": (EndoDavSettings(neck=(), head="video"), (29_242_593, 184_320)),
    "vits_dvlora_res_convhead": (EndoDavSettings(), (29_560_068, 529_540)),
}
every_set = pytest.mark.parametrize("name", OPTION_SETS)


def listed(name: str) -> dict[str, Entry]:
    path = REFERENCE / "endodav" / f"state_dict_{name}.tsv"
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {row["key"]: (tuple(int(side) for side in row["shape"].split("x")), row["dtype"]) for row in rows}


@cache
def on_paper(settings: EndoDavSettings) -> EndoDav:
    with torch.device("meta"):
        return EndoDav(settings)


@every_set
def test_keys_shapes_and_kinds_are_the_published_ones(name: str) -> None:
    state = on_paper(OPTION_SETS[name][0]).state_dict()
    observed = {key: (tuple(value.shape), str(value.dtype).removeprefix("torch.")) for key, value in state.items()}
    assert observed == listed(name)


@every_set
def test_option_sets_are_told_by_their_keys(name: str) -> None:
    shapes = {key: shape for key, (shape, _) in listed(name).items()}
    file = WeightFile(Path("depth_model.pth"), shapes, {}, torch.zeros)
    assert settings_of(file) == OPTION_SETS[name][0]


@every_set
def test_parameters_are_as_many_as_published_and_so_are_those_that_train(name: str) -> None:
    settings, (all_parameters, trained) = OPTION_SETS[name]
    network = on_paper(settings)
    assert sum(value.numel() for value in network.parameters()) == all_parameters
    assert sum(value.numel() for value in parameters(network, 0)) == trained
    assert sum(value.numel() for value in network.parameters() if value.requires_grad) == trained


@pytest.mark.parametrize(("step", "trained"), [(0, 1_667_076), (19_999, 1_667_076), (20_000, 1_344_612)])
def test_endodac_trains_as_many_parameters_as_published_in_either_phase(step: int, trained: int) -> None:
    with torch.device("meta"):
        network = DepthNetwork(DEPTH_SETTINGS["base"])
    assert sum(value.numel() for value in depth_parameters(network, step)) == trained

"""Parameter names and shapes against the lists of the published checkpoints."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import pytest
import torch

from bathyscope_train.model import Network, get_preset

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
ANYSPLAT = REFERENCE / "anysplat" / "state_dict.tsv"
VGGT = REFERENCE / "anysplat" / "vggt_1b_state_dict.tsv"


def listed(path: Path) -> dict[str, tuple[int, ...]]:
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return {row["key"]: tuple(int(side) for side in row["shape"].split("x")) for row in rows}


def built(preset: str, prefix: str = "") -> dict[str, tuple[int, ...]]:
    with torch.device("meta"):
        network = Network(get_preset(preset))
    return {prefix + key: tuple(value.shape) for key, value in network.state_dict().items()}


def test_full_size_preset_has_the_published_keys_and_shapes() -> None:
    expected = {key: shape for key, shape in listed(ANYSPLAT).items() if ".distill_" not in key}
    observed = built("anysplat", "encoder.")
    assert observed == expected
    assert len(observed) == 1405
    assert sum(torch.Size(shape).numel() for shape in observed.values()) == 1_190_736_456


def test_vggt_preset_has_the_published_keys_of_the_parts_it_shares() -> None:
    expected = {key: shape for key, shape in listed(VGGT).items() if not key.startswith(("point_head.", "track_head."))}
    assert built("vggt") == expected

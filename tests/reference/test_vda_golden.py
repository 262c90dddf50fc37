"""Video Depth Anything against runs of the published implementation (every folder of ``vda/`` with a config)."""

from __future__ import annotations

import csv
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
from torch.utils.hooks import RemovableHandle

from bathyscope.affine_stitch import AffineStitcher
from bathyscope.clip import Clip
from bathyscope.keyed_windows import KeyedWindows, keyed_windows
from bathyscope.vision.shorter_side import network_size, to_network
from bathyscope_train.systems.vda.network import VideoDepthAnything, normalised
from bathyscope_train.systems.vda.settings import SIZES, VdaSettings
from bathyscope_train.systems.vda.system import vda_system

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference")) / "vda"
CASES = sorted(path.parent for path in REFERENCE.glob("*/config.json"))
STITCHED = sorted(REFERENCE.glob("stitch_*.npz"))
TABLE = REFERENCE / "resize_table.tsv"

every_case = pytest.mark.parametrize("folder", CASES or [pytest.param(None, marks=pytest.mark.skip)], ids=str)
every_stitch = pytest.mark.parametrize("path", STITCHED or [pytest.param(None, marks=pytest.mark.skip)], ids=str)


def settings_of(config: dict[str, object]) -> VdaSettings:
    names = {
        "embed_dim": "width",
        "depth": "depth",
        "num_heads": "heads",
        "layers": "taps",
        "features": "features",
        "out_channels": "channels",
        "pos_grid": "grid",
        "patch_size": "patch_size",
        "mlp_ratio": "mlp_ratio",
        "motion_heads": "motion_heads",
        "motion_groups": "motion_groups",
        "num_frames": "frames",
    }
    return VdaSettings.model_validate({ours: config[theirs] for theirs, ours in names.items() if theirs in config})


@cache
def network_of(folder: Path) -> VideoDepthAnything:
    network = VideoDepthAnything(settings_of(json.loads((folder / "config.json").read_text()))).eval()
    network.load_state_dict(load_file(folder / "weights.safetensors"))
    return network


@dataclass(frozen=True)
class Run:
    arrays: dict[str, np.ndarray]
    observed: dict[str, Tensor]
    """What our modules gave, by the names in the golden file."""
    depth: Tensor


@cache
def run(folder: Path) -> Run:
    network = network_of(folder)
    arrays = dict(np.load(folder / "forward.npz"))
    observed: dict[str, Tensor] = {}
    kept: dict[str, list[Tensor]] = {}
    hooks: list[RemovableHandle] = []

    def keep(name: str, module: nn.Module) -> None:
        hooks.append(module.register_forward_hook(lambda _, __, output: kept.setdefault(name, []).append(output)))

    for i, block in enumerate(network.pretrained.blocks):
        keep(f"block{i}_out", block)
    for i in range(4):
        keep(f"project{i}", network.head.projects[i])
        keep(f"motion{i}_out", network.head.motion_modules[i])
        keep(f"refinenet{i + 1}_out", getattr(network.head.scratch, f"refinenet{i + 1}"))
    keep("output_conv1", network.head.scratch.output_conv1)
    images = torch.from_numpy(arrays["input"])
    with torch.no_grad():
        depth = network.on_normalised(images)
        observed["tokens_in"] = network.pretrained.tokens_in(images.flatten(0, 1))
    for hook in hooks:
        hook.remove()
    for name, parts in kept.items():
        whole = torch.cat(parts)
        observed[name] = whole.transpose(1, 2) if name.startswith("motion") else whole
    return Run(arrays, observed, depth)


def assert_close(observed: Tensor | np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Within ``tolerance`` of the largest value; of long arrays the golden file keeps the first frames only."""
    values = np.asarray(observed)[tuple(slice(0, side) for side in expected.shape)]
    assert values.shape == expected.shape
    assert np.abs(values - expected).max() <= tolerance * np.abs(expected).max()


@every_case
def test_values_are_the_published_ones(folder: Path) -> None:
    case = run(folder)
    assert case.depth.shape == case.arrays["depth"].shape
    assert_close(case.depth, case.arrays["depth"], 2e-5)


@every_case
def test_every_step_on_the_way_is_the_published_one(folder: Path) -> None:
    case = run(folder)
    names = [name for name in case.arrays if name.startswith("inter_")]
    assert names
    for name in names:
        assert_close(case.observed[name.removeprefix("inter_")], case.arrays[name], 2e-5)


@every_case
def test_frames_are_prepared_as_published(folder: Path) -> None:
    video = np.load(folder / "video.npz")
    expected, frames = video["preprocessed_01"], video["frames"]
    size = network_size(frames.shape[1:3], int(video["input_size"]), network_of(folder).settings.patch_size)
    assert size == expected.shape[-2:]
    observed = normalised(torch.from_numpy(np.stack([to_network(frame, size) for frame in frames[: len(expected)]])))
    assert np.abs(observed.numpy() - expected).max() <= 1e-4


@every_case
def test_a_long_video_is_the_published_one_from_frames_to_stitched_maps(folder: Path) -> None:
    video = np.load(folder / "video.npz")
    frames = video["frames"]
    config = json.loads((folder / "config.json").read_text())
    metric = bool(video["metric"]) if "metric" in video else bool(config.get("metric", False))
    system = vda_system(network_of(folder), name="golden", metric=metric, input_size=int(video["input_size"]))
    estimates = list(system.estimate(Clip(frames, np.arange(len(frames)) / 25.0)))
    assert [estimate.index for estimate in estimates] == list(range(len(frames)))
    assert_close(np.stack([estimate.values for estimate in estimates]), video["depths"], 1e-4)


@every_stitch
def test_windows_hold_the_published_frames(path: Path) -> None:
    golden = np.load(path)
    count = int(golden["num_frames"])
    windows = list(keyed_windows(range(count), KeyedWindows()))
    expected = np.minimum(golden["window_frame_ids"], count - 1)  # frames beyond the end repeat the last one
    assert [window.items for window in windows] == [tuple(ids) for ids in expected]
    assert sum(window.fresh for window in windows) == count


@every_stitch
def test_stitched_windows_are_the_published_ones(path: Path) -> None:
    golden = np.load(path)
    rule = KeyedWindows(fit="none" if golden["metric"] else "references")
    stitcher = AffineStitcher(rule)
    observed: list[np.ndarray] = []
    windows = keyed_windows(range(int(golden["num_frames"])), rule)
    for window, maps in zip(windows, golden["window_depths"], strict=True):
        observed.extend(stitcher.add(maps, window.fresh))
    observed.extend(stitcher.finish())
    assert_close(np.stack(observed), golden["stitched"], 1e-5)
    if len(golden["scale_shift"]):
        np.testing.assert_allclose(stitcher.affine, golden["scale_shift"], rtol=1e-5, atol=1e-5)


@pytest.mark.skipif(not TABLE.is_file(), reason=f"{TABLE} is missing")
def test_sizes_are_the_published_ones() -> None:
    with TABLE.open(newline="") as file:
        rows = [{name: int(value) for name, value in row.items()} for row in csv.DictReader(file, delimiter="\t")]
    assert rows
    for row in rows:
        observed = network_size((row["frame_h"], row["frame_w"]), row["requested_input_size"])
        assert observed == (row["net_h"], row["net_w"]), row


@pytest.mark.parametrize("letter", sorted(SIZES))
def test_full_size_networks_have_the_published_keys_and_shapes(letter: str) -> None:
    path = REFERENCE / f"state_dict_vit{letter}.tsv"
    if not path.is_file():
        pytest.skip(f"{path} is missing")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    expected = {row["key"]: tuple(int(side) for side in row["shape"].split("x")) for row in rows}
    with torch.device("meta"):
        network = VideoDepthAnything(SIZES[letter])
    assert {key: tuple(value.shape) for key, value in network.state_dict().items()} == expected

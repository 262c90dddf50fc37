"""EndoDAV against runs of the published implementation (every folder of ``endodav/`` with a config)."""

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

from bathyscope.affine_stitch import AffineStitcher
from bathyscope.clip import Clip
from bathyscope.depth_range import DepthRange
from bathyscope.keyed_windows import keyed_windows
from bathyscope.resizing import resize_corners
from bathyscope_train.systems.endodav import EndoDav, EndoDavSettings
from bathyscope_train.systems.endodav.system import endodav_system
from bathyscope_train.systems.vda.settings import VdaSettings

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted(path.parent for path in (REFERENCE / "endodav").glob("*/config.json"))
TOLERANCE = 1e-4

pytestmark = pytest.mark.skipif(not CASES, reason=f"no endodav/*/config.json under {REFERENCE}")
every_case = pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)


@dataclass(frozen=True)
class Run:
    """One case: what was asked, what the published network computed on the way and said."""

    network: EndoDav
    arrays: dict[str, np.ndarray]
    observed: dict[str, Tensor]
    """What our modules gave, by their names in the checkpoint."""
    disparities: tuple[Tensor, ...]


def settings_of(folder: Path) -> EndoDavSettings:
    config = json.loads((folder / "config.json").read_text())
    lora = config.get("lora_type")
    return EndoDavSettings(
        network=VdaSettings(
            width=config["embed_dim"],
            depth=config["depth"],
            heads=config["num_heads"],
            taps=tuple(config["layers"]),
            grid=config["pos_grid"],
            features=config["features"],
            channels=tuple(config["out_channels"]),
            frames=config["num_frames"],
        ),
        image_size=tuple(config["image_shape"]),
        adapter=None if lora in (None, "none") else lora,
        temporal_adapter=config.get("temporal_lora", False),
        rank=config["r"],
        neck=tuple(config.get("residual_block_indexes", ())),
        head="video" if config.get("disable_conv_head") else "sigmoid",
        output="sigmoid" if config.get("out_sigmoid") else "relu",
        depth_range=DepthRange(nearest=config["min_depth"], farthest=config["max_depth"]),
    )


@cache
def load(folder: Path) -> EndoDav:
    network = EndoDav(settings_of(folder)).eval()
    network.load_state_dict(load_file(folder / "weights.safetensors"))
    return network


@cache
def run(folder: Path) -> Run:
    network = load(folder)
    with np.load(folder / "forward.npz") as file:
        arrays = dict(file)
    observed: dict[str, Tensor] = {}

    def keep(name: str) -> object:
        def hook(_: nn.Module, __: object, output: Tensor) -> None:
            observed.setdefault(name, output)

        return hook

    names = [key.removeprefix("inter_") for key in arrays if key.startswith("inter_")]
    hooks = [network.get_submodule(name).register_forward_hook(keep(name)) for name in names]
    with torch.no_grad():
        disparities = network(torch.from_numpy(arrays["input"]))
    for hook in hooks:
        hook.remove()
    return Run(network, arrays, observed, disparities)


def assert_close(observed: Tensor | np.ndarray, expected: np.ndarray) -> None:
    assert observed.shape == expected.shape
    assert np.abs(np.asarray(observed) - expected).max() <= TOLERANCE * np.abs(expected).max()


@every_case
def test_intermediate_maps_match(folder: Path) -> None:
    case = run(folder)
    names = [key for key in case.arrays if key.startswith("inter_")]
    assert names
    for name in names:
        observed, expected = case.observed[name.removeprefix("inter_")], case.arrays[name]
        if "motion_modules" in name:
            observed = observed.transpose(1, 2)
        frames = min(len(observed), len(expected))  # the fine half runs on chunks of frames; hooks keep the first chunk
        assert frames > 0
        assert_close(observed[:frames], expected[:frames])


@every_case
def test_disparities_of_all_scales_match(folder: Path) -> None:
    case = run(folder)
    for scale in range(4):
        assert_close(case.disparities[scale], case.arrays[f"disp_{scale}"])


@every_case
def test_merging_leaves_no_adapter_and_the_same_disparities(folder: Path) -> None:
    case = run(folder)
    merged = case.network.merge()
    assert not any("lora" in name for name in merged.state_dict())
    with torch.no_grad():
        for observed, expected in zip(merged(torch.from_numpy(case.arrays["input"])), case.disparities, strict=True):
            torch.testing.assert_close(observed, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)


@every_case
def test_the_two_stages_of_an_exported_network_give_the_finest_disparity(folder: Path) -> None:
    case = run(folder)
    with torch.no_grad():
        maps = case.network.mixed(torch.from_numpy(case.arrays["input"][0]))
        alone = [case.network.finish(*(each[i : i + 1] for each in maps)) for i in range(len(maps[0]))]
    assert_close(torch.cat(alone), case.arrays["disp_0"][:, 0])


@cache
def video(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "video.npz") as file:
        return dict(file)


@cache
def estimated(folder: Path) -> np.ndarray:
    frames = video(folder)["frames"]
    system = endodav_system(load(folder), name="golden")
    return np.stack([frame.values for frame in system.estimate(Clip(frames, np.arange(len(frames)) / 25.0))])


@every_case
def test_depth_of_a_long_video_is_the_published_one(folder: Path) -> None:
    """Compared as inverse depth: next to the farthest depth, rounding of the disparity is magnified 200,000 times."""
    assert_close(1 / estimated(folder), 1 / video(folder)["depth"])


@every_case
def test_stitched_disparity_and_its_scales_are_the_published_ones(folder: Path) -> None:
    golden = video(folder)
    system = endodav_system(load(folder), name="golden").disparities
    frames, stitcher = golden["frames"], AffineStitcher(system.rule)
    observed: list[np.ndarray] = []
    for window in keyed_windows(map(system.prepare, frames), system.rule):
        values = resize_corners(system.predict(np.stack(window.items)), frames.shape[1:3])
        observed.extend(stitcher.add(values, window.fresh))
    observed.extend(stitcher.finish())
    assert_close(np.stack(observed), golden["disp"])
    observed_affine, expected_affine = (np.reshape(each, (-1, 2)) for each in (stitcher.affine, golden["scale_shift"]))
    np.testing.assert_allclose(observed_affine, expected_affine, rtol=1e-4, atol=1e-4)

"""The network against end-to-end runs of the published implementation (``anysplat/golden_*/``)."""

from __future__ import annotations

import json
import os
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from bathyscope_train.model import Network, NetworkPreset, Prediction
from bathyscope_train.model.gaussian_parameters import GaussianBatch, anysplat_gaussians
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.presets import (
    AggregatorSettings,
    DptSettings,
    IterativeCameraSettings,
    SceneSettings,
    VitSettings,
)
from bathyscope_train.model.rope import grid_positions, rope_tables, rotate
from bathyscope_train.model.scene import assemble_scene
from bathyscope_train.model.unprojection import invert_rigid, unproject
from bathyscope_train.model.voxels import fuse_batch, fuse_voxels

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted(path.parent for path in (REFERENCE / "anysplat").glob("golden_*/config.json"))
TOLERANCE = 2e-4

pytestmark = pytest.mark.skipif(not CASES, reason=f"no anysplat/golden_*/config.json under {REFERENCE}")
every_case = pytest.mark.parametrize("folder", CASES, ids=lambda path: path.name)


def preset_of(config: dict[str, Any]) -> NetworkPreset:
    def dpt(prefix: str, hidden: int) -> DptSettings:
        return DptSettings(
            features=config[f"{prefix}_features"], channels=tuple(config[f"{prefix}_out_channels"]), hidden=hidden
        )

    return NetworkPreset(
        name="golden",
        patch_size=config["patch_size"],
        stem=VitSettings(
            depth=config["dino_depth"],
            heads=config["dino_heads"],
            registers=config["num_register_tokens"],
            grid=config["img_size"] // config["patch_size"],
        ),
        aggregator=AggregatorSettings(
            width=config["embed_dim"],
            depth=config["depth"],
            heads=config["num_heads"],
            registers=config["num_register_tokens"],
            mlp_ratio=config["mlp_ratio"],
            rope_base=config["rope_freq"],
            taps=tuple(config["intermediate_layer_idx"]),
        ),
        camera=IterativeCameraSettings(
            depth=config["camera_trunk_depth"],
            heads=config["camera_num_heads"],
            iterations=config["camera_num_iterations"],
        ),
        depth=dpt("depth", 32),
        gaussians=dpt("gs", config["gs_hidden"]),
        harmonic_degree=config["sh_degree"],
        scene=SceneSettings(
            pixel_center=0.0,
            focal_epsilon=1e-3,
            activation="anysplat",
            opacity_exponent=config["opacity_mapping_initial"],
        ),
    )


@dataclass(frozen=True)
class Run:
    """One case: what was asked, what the network computed on the way, what it said."""

    folder: Path
    config: dict[str, Any]
    network: Network
    images: Tensor
    prediction: Prediction
    outputs: dict[str, list[Tensor]]
    inputs: dict[str, list[Tensor]]

    @property
    def frames(self) -> tuple[int, int]:
        return self.images.shape[0], self.images.shape[1]

    def expected(self, name: str) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"{name}.npz") as arrays:
            return dict(arrays)


def record(network: nn.Module) -> tuple[dict[str, list[Tensor]], dict[str, list[Tensor]]]:
    """What goes into and comes out of every sub-module, call by call."""
    outputs: dict[str, list[Tensor]] = defaultdict(list)
    inputs: dict[str, list[Tensor]] = defaultdict(list)
    for name, module in network.named_modules():

        def keep(_: nn.Module, args: tuple[Any, ...], output: Any, name: str = name) -> None:
            if isinstance(output, Tensor):
                outputs[name].append(output)
                inputs[name].append(args[0])

        module.register_forward_hook(keep)
    return outputs, inputs


@cache
def run(folder: Path) -> Run:
    config = json.loads((folder / "config.json").read_text())
    network = Network(preset_of(config)).eval()
    weights = load_file(folder / "weights.safetensors")
    network.load_state_dict({key.removeprefix("encoder."): value.float() for key, value in weights.items()})
    outputs, inputs = record(network)
    with np.load(folder / "inputs.npz") as arrays:
        images = torch.from_numpy(arrays["images"])
    with torch.no_grad():
        prediction = network(images)
    return Run(folder, config, network, images, prediction, outputs, inputs)


def assert_same(observed: Tensor, expected: np.ndarray, what: str) -> None:
    assert observed.shape == expected.shape, f"{what}: {tuple(observed.shape)} for {expected.shape}"
    error = np.abs(observed.double().numpy() - expected) / (1 + np.abs(expected))
    assert error.max(initial=0) <= TOLERANCE, f"{what}: {error.max():.2e}"


@every_case
def test_image_encoder_matches_layer_by_layer(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("aggregator")
    stem = "aggregator.patch_embed"
    assert_same(case.outputs[f"{stem}.patch_embed"][0], expected["dino_patch_proj"], "patches")
    assert_same(case.inputs[f"{stem}.blocks.0"][0], expected["dino_tokens_in"], "tokens in")
    for index in range(case.config["dino_depth"]):
        assert_same(case.outputs[f"{stem}.blocks.{index}"][0], expected[f"dino_block{index}"], f"block {index}")
    assert_same(case.outputs[f"{stem}.norm"][0], expected["dino_norm_all"], "norm")
    assert_same(case.outputs[stem][0], expected["patch_tokens"], "patch tokens")


@every_case
def test_alternating_attention_matches_layer_by_layer(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("aggregator")
    shape = (*case.frames, *expected["agg_tokens_in"].shape[1:])
    assert_same(case.inputs["aggregator.frame_blocks.0"][0], expected["agg_tokens_in"], "tokens in")
    compared = 0
    for index in range(case.config["depth"]):
        for kind in ("frame", "global"):
            if f"agg_{kind}{index}" in expected:
                observed = case.outputs[f"aggregator.{kind}_blocks.{index}"][0].reshape(shape)
                assert_same(observed, expected[f"agg_{kind}{index}"], f"{kind} {index}")
                compared += 1
    assert compared >= 2 * len(case.config["intermediate_layer_idx"])


@every_case
def test_queries_and_keys_match_before_and_after_the_rotation(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("aggregator")
    height, width = (side // case.config["patch_size"] for side in case.images.shape[-2:])
    positions = grid_positions(height, width, 1 + case.config["num_register_tokens"], device=torch.device("cpu"))
    np.testing.assert_array_equal(
        positions.expand_as(torch.from_numpy(expected["rope_positions"])), expected["rope_positions"]
    )
    head_dim = case.config["embed_dim"] // case.config["num_heads"]
    tables = rope_tables(positions, head_dim, base=case.config["rope_freq"])
    for name in "qk":
        normed = case.outputs[f"aggregator.frame_blocks.0.attn.{name}_norm"][0]
        assert_same(normed.transpose(1, 2), expected[f"agg_frame0_{name}_normed"], f"{name} normed")
        assert_same(rotate(normed, tables).transpose(1, 2), expected[f"agg_frame0_{name}_rope"], f"{name} rotated")


@every_case
def test_heads_are_given_the_tapped_layers_and_no_other_is_kept(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("aggregator")
    with torch.no_grad():
        layers = case.network.aggregator(case.images).layers
    taps = case.config["intermediate_layer_idx"]
    assert set(layers) == {*taps, case.config["depth"] - 1}
    for k, layer in enumerate(taps):
        assert_same(layers[layer], expected[f"agg_list{k}_layer{layer}"], f"layer {layer}")


@every_case
def test_camera_head_matches_at_every_iteration(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("camera")
    assert_same(case.outputs["camera_head.token_norm"][0], expected["pose_tokens_normed"], "tokens")
    steps = {
        "embed_pose": "embed_pose",
        "modulation": "poseLN_modulation",
        "trunk_out": f"trunk.{case.config['camera_trunk_depth'] - 1}",
        "delta": "pose_branch",
    }
    for index in range(case.config["camera_num_iterations"]):
        for name, module in steps.items():
            observed = case.outputs[f"camera_head.{module}"][index]
            assert_same(observed, expected[f"{name}_iter{index}"], f"{name} of iteration {index}")
        encoding = case.prediction.pose_encodings[index]
        assert_same(encoding, expected[f"pose_enc_iter{index}"], f"encoding of iteration {index}")


@every_case
def test_decoded_cameras_match(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("camera")
    height, width = case.images.shape[-2:]
    cameras = decode_cameras(case.prediction.pose_encoding, (height, width), focal_epsilon=1e-3)
    assert_same(cameras.camera_from_world[..., :3, :], expected["extrinsics_w2c"], "camera from world")
    assert_same(invert_rigid(cameras.camera_from_world), expected["extrinsics_c2w_4x4"], "world from camera")
    assert_same(cameras.intrinsics, expected["intrinsics_px"], "intrinsics")
    normalised = cameras.intrinsics / torch.tensor([width, height, 1.0])[:, None]
    assert_same(normalised, expected["intrinsics_normalized"], "normalised intrinsics")


def dpt_levels(case: Run, head: str) -> dict[str, Tensor]:
    """Intermediate maps of a DPT head for the first frame, named as in the files."""
    names = {"output_conv1_frame0": "scratch.output_conv1", "input_merger_frame0": "input_merger"}
    for k in range(4):
        names[f"project{k}_frame0"] = f"projects.{k}"
        names[f"resize{k}_frame0"] = f"resize_layers.{k}"
        names[f"layer{k + 1}_rn_frame0"] = f"scratch.layer{k + 1}_rn"
        names[f"refinenet{k + 1}_frame0"] = f"scratch.refinenet{k + 1}"
    levels = {name: case.outputs[f"{head}.{module}"] for name, module in names.items()}
    levels["fused_full_frame0"] = case.inputs[f"{head}.scratch.output_conv2"]
    return {name: calls[0][:1] for name, calls in levels.items() if calls}


@pytest.mark.parametrize(("head", "file"), [("depth_head", "depth_head"), ("gaussian_param_head", "gs_head")])
@every_case
def test_dense_heads_match_level_by_level(folder: Path, head: str, file: str) -> None:
    case = run(folder)
    expected = case.expected(file)
    levels = dpt_levels(case, head)
    for name in expected:
        if name.endswith("_frame0"):
            assert_same(levels[name], expected[name], name)
    raw = case.outputs[f"{head}.scratch.output_conv2"][0].unflatten(0, case.frames)
    assert_same(raw, expected["raw_out"], "raw")


@every_case
def test_depth_confidence_and_points_match(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("depth_head")
    maps = case.prediction.maps
    assert_same(maps.depth[..., None], expected["depth"], "depth")
    assert_same(maps.confidence, expected["depth_conf"], "confidence")
    cameras = decode_cameras(case.prediction.pose_encoding, maps.depth.shape[-2:], focal_epsilon=1e-3)
    points = unproject(maps.depth, cameras.intrinsics, invert_rigid(cameras.camera_from_world), pixel_center=0.0)
    assert_same(points, expected["world_points"], "points")


def given_points(case: Run) -> tuple[Tensor, Tensor, Tensor]:
    """Points, raw features and fusion confidence from the files: voxel cells depend on the last bit of a point."""
    points = torch.from_numpy(case.expected("depth_head")["world_points"]).flatten(1, 3)
    raw = torch.from_numpy(case.expected("gs_head")["raw_out"]).movedim(2, -1).flatten(1, 3)
    return points, raw[..., :-1], raw[..., -1]


def assert_gaussians(observed: GaussianBatch, expected: dict[str, np.ndarray], prefix: str) -> None:
    assert_same(observed.means, expected[f"{prefix}_means"], "means")
    assert_same(observed.scales, expected[f"{prefix}_scales"], "scales")
    assert_same(observed.rotations.roll(-1, dims=-1), expected[f"{prefix}_rotations"], "rotations")
    assert_same(observed.opacities, expected[f"{prefix}_opacities"], "opacities")
    if f"{prefix}_harmonics" in expected:
        assert_same(observed.harmonics.transpose(-1, -2), expected[f"{prefix}_harmonics"], "harmonics")


@every_case
def test_gaussians_of_every_pixel_match(folder: Path) -> None:
    case = run(folder)
    points, features, _ = given_points(case)
    exponent = case.config["opacity_mapping_initial"]
    observed = anysplat_gaussians(points, features, opacity_exponent=exponent)
    assert_gaussians(observed, case.expected("gaussians"), "pix")


@every_case
def test_whole_pipeline_places_the_gaussians(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("gaussians")
    scene = assemble_scene(case.prediction, case.images, case.network.preset.scene, rebase=False)
    assert_same(scene.gaussians.means, expected["pix_means"], "means")
    assert_same(scene.gaussians.scales, expected["pix_scales"], "scales")
    assert_same(scene.gaussians.opacities, expected["pix_opacities"], "opacities")


@every_case
def test_voxels_hold_the_same_pixels_and_averages(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("gaussians")
    for b, scene in enumerate(zip(*given_points(case), strict=True)):
        fused = fuse_voxels(*scene, voxel_size=case.config["voxel_size"])
        np.testing.assert_array_equal(fused.index, expected[f"vox_index_b{b}"])
        np.testing.assert_array_equal(fused.counts, expected[f"vox_count_b{b}"])
        features = expected[f"vox_merged_feats_first1000_b{b}"]
        assert_same(fused.features[: len(features)], features, "fused features")


@every_case
def test_fused_gaussians_match(folder: Path) -> None:
    case = run(folder)
    expected = case.expected("gaussians")
    points, features = fuse_batch(*given_points(case), voxel_size=case.config["voxel_size"])
    gaussians = anysplat_gaussians(points, features, opacity_exponent=case.config["opacity_mapping_initial"])
    assert_gaussians(gaussians, expected, "vox")
    covariances = covariance(gaussians)
    wanted = expected["vox_covariances_first500"]
    assert_same(covariances[:, : wanted.shape[1]], wanted, "covariances")


def covariance(gaussians: GaussianBatch) -> Tensor:
    """R diag(s^2) R^T, with the published 1e-8 in the quaternion's norm."""
    w, x, y, z = gaussians.rotations.unbind(-1)
    s = 2 / (gaussians.rotations.square().sum(-1) + 1e-8)
    rotation = torch.stack(
        [
            torch.stack([1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)], -1),
            torch.stack([s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)], -1),
            torch.stack([s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)], -1),
        ],
        -2,
    )
    return rotation * gaussians.scales.square()[..., None, :] @ rotation.transpose(-1, -2)

"""The exported graphs against PyTorch, their memory, and the bundle around them."""

from __future__ import annotations

import fcntl
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from onnx import TensorProto, helper
from typer.testing import CliRunner

from bathyscope.bundle import Bundle, Role
from bathyscope.errors import BundleError
from bathyscope.model_spec import InputSpec
from bathyscope_export.attention import check_linear_attention, fused_count
from bathyscope_export.cli import app
from bathyscope_export.graph import export_stage
from bathyscope_export.parity import Difference, compare, run_graphs, sample_clip
from bathyscope_export.stages import split
from bathyscope_export.weights import ALIGNMENT, externalise
from bathyscope_export.writer import BundleSettings, strip_paths, write_bundle
from bathyscope_train.model import Network, NetworkPreset, get_preset
from bathyscope_train.model.checkpoints import save_checkpoint
from bathyscope_train.model.presets import (
    AggregatorSettings,
    DptSettings,
    IterativeCameraSettings,
    MatchingCameraSettings,
    SceneSettings,
    VitSettings,
)
from bathyscope_train.model.specs import scene_spec

SMALL = NetworkPreset(
    name="small",
    stem=VitSettings(depth=1, heads=2, grid=5),
    aggregator=AggregatorSettings(width=32, depth=4, heads=2, taps=(0, 1, 2, 3)),
    camera=IterativeCameraSettings(depth=1, heads=2, iterations=2),
    depth=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    gaussians=DptSettings(features=8, channels=(4, 4, 8, 8), hidden=4),
    harmonic_degree=1,
    scene=SceneSettings(pixel_center=0.0, focal_epsilon=1e-3, activation="anysplat", voxel_size=0.01),
)
SETTINGS = BundleSettings(
    name="small",
    version="7",
    input=InputSpec(patch=14, pixels=112 * 140, window=4, overlap=1),
    training={"settings": {"data": ["/home/somebody/clips"], "steps": 3}},
    shapes=((1, 8, 10), (3, 5, 4)),
)


def random_network() -> Network:
    """Weights large enough that maps vary and cameras move: parity of a constant proves nothing."""
    torch.manual_seed(0)
    network = Network(SMALL).eval()
    for name, parameter in network.named_parameters():
        if name.endswith("gamma"):
            torch.nn.init.uniform_(parameter, 0.5, 1.0)
        if name.endswith("empty_pose_tokens"):
            torch.nn.init.normal_(parameter)
    with torch.no_grad():
        # A field of view near the middle of its range, and a quaternion near (0, 0, 0, 1).
        network.camera_head.pose_branch.fc2.bias.copy_(torch.tensor([0.1, 0.2, 0.3, 0, 0, 0, 0.7, 0.6, 0.7]))
    return network


@dataclass(frozen=True)
class Exported:
    network: Network
    bundle: Bundle


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Exported:
    """Exporting takes most of a minute, so all tests, in all worker processes, share one bundle."""
    network = random_network()
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "exported"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        bundle = Bundle.open(folder) if folder.exists() else write_bundle(network, folder, SETTINGS)
    return Exported(network, bundle)


def graph(exported: Exported, role: Role) -> onnx.ModelProto:
    return onnx.load(exported.bundle.graph(role))


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 4, 4), (2, 8, 10), (5, 3, 7)], ids=str)
def test_graphs_say_what_the_network_says_at_any_length_and_size(
    exported: Exported, shape: tuple[int, int, int]
) -> None:
    graphs = exported.bundle.manifest.graphs
    (difference,) = compare(exported.network, exported.bundle.folder, graphs, (shape,))
    assert (difference.frames, difference.height, difference.width) == (shape[0], 14 * shape[1], 14 * shape[2])
    difference.check()
    assert difference.gaussians < 1e-4
    assert difference.confidence < 1e-4


@pytest.mark.slow
def test_heads_give_the_same_in_chunks_of_frames(exported: Exported) -> None:
    graphs = exported.bundle.manifest.graphs
    sessions = {role: ort.InferenceSession(exported.bundle.graph(role)) for role in graphs}
    known = run_graphs(sessions, graphs, sample_clip(3, 56, 70).numpy())
    for frame in range(3):
        feed = {name: known[name][frame : frame + 1] for name in graphs["heads"].inputs}
        for name, value in zip(graphs["heads"].outputs, sessions["heads"].run(None, feed), strict=True):
            np.testing.assert_allclose(value[0], known[name][frame], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_inputs_and_outputs_are_named_with_their_axes(exported: Exported) -> None:
    backbone, heads, cameras = (exported.bundle.manifest.graphs[role] for role in ("backbone", "heads", "cameras"))
    tokens = tuple(f"tokens_{k}" for k in range(4))
    assert backbone.inputs == ("images",)
    assert backbone.outputs == (*tokens, "camera")
    assert (heads.inputs, heads.outputs) == (("images", *tokens), ("depth", "confidence", "gaussians"))
    assert (cameras.inputs, cameras.outputs) == (("camera",), ("pose_encoding",))
    session = ort.InferenceSession(exported.bundle.graph("heads"))
    shapes = {value.name: value.shape for value in (*session.get_inputs(), *session.get_outputs())}
    assert shapes["images"] == ["frames", 3, "height", "width"]
    assert shapes["tokens_0"] == ["frames", "rows", "columns", 64]
    assert shapes["depth"] == ["frames", "height", "width"]
    assert shapes["gaussians"] == ["frames", SMALL.gaussian_channels + 1, "height", "width"]


@pytest.mark.slow
def test_every_attention_is_one_fused_node_and_no_softmax_is_left(exported: Exported) -> None:
    assert fused_count(graph(exported, "backbone")) == 1 + 2 * 4
    assert fused_count(graph(exported, "cameras")) == 2
    for role in ("backbone", "heads", "cameras"):
        assert not [node for node in graph(exported, role).graph.node if node.op_type == "Softmax"]


@pytest.mark.slow
def test_graphs_carry_no_notes_of_the_machine_that_made_them(exported: Exported) -> None:
    for entry in exported.bundle.folder.iterdir():
        if entry.suffix != ".bin":
            content = entry.read_bytes()
            assert str(Path(__file__).parents[2]).encode() not in content, entry.name
            assert b"site-packages" not in content, entry.name
            assert b"/home/somebody" not in content, entry.name


@pytest.mark.slow
def test_graphs_share_one_weights_file_of_about_the_size_of_the_parameters(exported: Exported) -> None:
    parameters = 4 * sum(p.numel() for p in exported.network.parameters())
    weights = exported.bundle.folder / exported.bundle.manifest.weights
    assert 0.9 * parameters < weights.stat().st_size < 1.1 * parameters + 65536
    for role in ("backbone", "heads", "cameras"):
        model = onnx.load(exported.bundle.graph(role), load_external_data=False)
        assert any(tensor.data_location == TensorProto.EXTERNAL for tensor in model.graph.initializer)


@pytest.mark.slow
def test_manifest_tells_scene_parity_and_training(exported: Exported) -> None:
    manifest = exported.bundle.manifest
    assert (manifest.name, manifest.version, manifest.preset) == ("small", "7", "small")
    assert (manifest.scene.pixel_centre, manifest.scene.focal_epsilon, manifest.scene.sh_degree) == (0.0, 1e-3, 1)
    assert (manifest.scene.activation, manifest.scene.voxel_size) == ("anysplat", 0.01)
    assert [(record["frames"], record["height"]) for record in manifest.parity] == [(1, 112), (3, 70)]
    assert manifest.training == {"settings": {"data": ["clips"], "steps": 3}}
    assert set(manifest.files) == {"backbone.onnx", "heads.onnx", "cameras.onnx", "weights.bin", "card.md"}


@pytest.mark.slow
def test_backbone_memory_grows_with_tokens_and_not_with_their_square(exported: Exported) -> None:
    """Peak memory of a process that runs T frames, for three T: the second step is twice the first, not four times."""
    program = (
        "import sys, numpy as np, onnxruntime as ort\n"
        "options = ort.SessionOptions(); options.enable_cpu_mem_arena = False; options.intra_op_num_threads = 1\n"
        "session = ort.InferenceSession(sys.argv[1], options)\n"
        "images = np.zeros((int(sys.argv[2]), 3, 224, 224), np.float32)\n"
        "session.run(None, {'images': images})\n"
        # Not ru_maxrss, which starts at the peak of the process that this one was forked from.
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))\n"
    )
    path = str(exported.bundle.graph("backbone"))
    peaks_kb = [
        int(subprocess.run([sys.executable, "-c", program, path, str(t)], capture_output=True, check=True).stdout)
        for t in (8, 16, 32)
    ]
    # 32 frames are 8352 tokens: one matrix of attention weights would take 558 MB for the two heads.
    assert peaks_kb[2] - peaks_kb[1] < 3 * (peaks_kb[1] - peaks_kb[0])
    assert peaks_kb[2] - peaks_kb[0] < 200_000


@pytest.mark.slow
def test_an_existing_bundle_is_replaced_only_when_told(exported: Exported, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="exists; remove it"):
        write_bundle(exported.network, exported.bundle.folder, SETTINGS)
    with pytest.raises(BundleError, match="exists and is no bundle"):
        write_bundle(exported.network, tmp_path, SETTINGS, replace=True)


@pytest.mark.slow
def test_cameras_solved_from_matches_export_too(tmp_path: Path) -> None:
    """The tiny preset's solver, with one round and one iteration: tracing all of it takes minutes."""
    torch.manual_seed(0)
    preset = get_preset("tiny")
    small = {
        "aggregator": preset.aggregator.model_copy(update={"width": 24, "depth": 1, "heads": 1, "taps": (0,)}),
        "camera": MatchingCameraSettings(rounds=1, iterations=1, focal_steps=1, final_iterations=1, settling=1),
    }
    network = Network(preset.model_copy(update=small)).eval()
    torch.nn.init.normal_(network.camera_head.refiner.readout.weight, std=0.05)
    backbone, _, cameras = split(network)
    model = export_stage(cameras, patch=14)
    externalise([model], tmp_path / "weights.bin")
    (tmp_path / "cameras.onnx").write_bytes(model.SerializeToString())
    session = ort.InferenceSession(tmp_path / "cameras.onnx")
    assert (
        [value.name for value in session.get_inputs()]
        == list(cameras.inputs)
        == ["depth", "camera", "tokens_0", "stem_1", "focal"]
    )
    for frames, height, width, focal in ((1, 56, 70, 0.0), (6, 84, 56, 0.0), (6, 84, 56, 70.0)):
        images = sample_clip(frames, height, width)
        with torch.no_grad():
            known = dict(zip(backbone.outputs, backbone.module(images), strict=True))
            known |= {"depth": 1 + images.mean(1), "focal": torch.tensor([focal])}
            expected = [each.numpy() for each in cameras.module(*(known[name] for name in cameras.inputs))]
        observed = session.run(None, {name: known[name].numpy() for name in cameras.inputs})
        assert frames == 1 or np.abs(expected[0][1:, :3]).max() > 1e-3
        # Matches of an untrained network contradict each other, and the solver amplifies rounding.
        np.testing.assert_allclose(observed[0], expected[0], atol=5e-5)
        np.testing.assert_allclose(observed[1], expected[1], atol=5e-5)
        if focal:
            np.testing.assert_allclose(observed[0][:, 7], 2 * np.arctan(height / 2 / focal), atol=1e-5)


def test_a_difference_beyond_rounding_stops_the_export() -> None:
    fine = Difference(2, 28, 28, depth=9e-5, confidence=0, gaussians=0, rotation=9e-6, translation=0, field_of_view=0)
    fine.check()
    for name, value in (("depth", 2e-4), ("rotation", 2e-5), ("translation", float("nan")), ("field_of_view", 1.0)):
        wrong = Difference(**(fine.record() | {name: value}))
        with pytest.raises(BundleError, match=rf"2 frames of 28x28: {name} "):
            wrong.check()


def test_a_network_whose_own_depth_moves_with_the_last_bit_is_given_as_much_room() -> None:
    rough = Difference(2, 28, 28, 2e-4, 0, 0, 0, 0, 0, rounding=7e-5)
    rough.check()
    with pytest.raises(BundleError, match=r"depth 2\.0e-04 \(at most 1\.8e-04"):
        replace(rough, rounding=6e-5).check()
    with pytest.raises(BundleError, match="rotation"):
        replace(rough, rotation=2e-5).check()


def test_decomposed_attention_is_refused() -> None:
    shape = ["frames", "tokens", "tokens"]
    scores = helper.make_tensor_value_info("scores", TensorProto.FLOAT, shape)
    tokens = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["frames", "tokens", 8])
    model = helper.make_model(
        helper.make_graph(
            [
                helper.make_node("Transpose", ["x"], ["y"], perm=[0, 2, 1]),
                helper.make_node("MatMul", ["x", "y"], ["scores"]),
            ],
            "g",
            [tokens],
            [scores],
            value_info=[helper.make_tensor_value_info("y", TensorProto.FLOAT, ["frames", 8, "tokens"])],
        )
    )
    with pytest.raises(BundleError, match=r"backbone: scores has shape \(\.\.\., S, S\)"):
        check_linear_attention(model, "backbone")


def test_fused_attention_with_a_mask_is_refused() -> None:
    node = helper.make_node("MultiHeadAttention", ["q", "k", "v", "", "mask"], ["y"], domain="com.microsoft")
    model = helper.make_model(helper.make_graph([node], "g", [], []))
    with pytest.raises(BundleError, match="a mask or bias makes it quadratic"):
        check_linear_attention(model, "backbone")


def test_a_graph_without_shapes_cannot_be_checked() -> None:
    nodes = [helper.make_node("Relu", [name], [after]) for name, after in ("xa", "ab", "by")]
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, ["frames", 3])
    model = helper.make_model(helper.make_graph(nodes, "g", [], [output]))
    with pytest.raises(BundleError, match="67% of the values have no known shape"):
        check_linear_attention(model, "heads")


def test_equal_tensors_of_several_graphs_are_stored_once(tmp_path: Path) -> None:
    shared, other = np.arange(600, dtype=np.float32), np.ones(700, np.float32)

    def model(*arrays: np.ndarray) -> onnx.ModelProto:
        tensors = [onnx.numpy_helper.from_array(array, f"w{k}") for k, array in enumerate(arrays)]
        return helper.make_model(helper.make_graph([], "g", [], [], initializer=tensors))

    models = [model(shared, np.zeros(3, np.float32)), model(other, shared)]
    externalise(models, tmp_path / "weights.bin")
    assert (tmp_path / "weights.bin").stat().st_size == 2432 + 2800  # 2400 bytes, filled up to a multiple of 64
    assert 2432 % ALIGNMENT == 0
    for index, source in enumerate(models):
        (tmp_path / f"{index}.onnx").write_bytes(source.SerializeToString())
        loaded = onnx.load(tmp_path / f"{index}.onnx")
        arrays = [onnx.numpy_helper.to_array(tensor) for tensor in loaded.graph.initializer]
        np.testing.assert_array_equal(arrays[index], shared)


def test_paths_are_cut_to_their_last_part() -> None:
    record = {"out": "/data/run7", "folders": ["/a/b", "c/d"], "steps": 3, "inner": {"x": "/y"}}
    assert strip_paths(record) == {"out": "run7", "folders": ["b", "c/d"], "steps": 3, "inner": {"x": "y"}}


def test_heads_of_a_network_without_gaussians_give_depth_alone() -> None:
    network = Network(SMALL.model_copy(update={"gaussians": None})).eval()
    _, heads, _ = split(network)
    model = export_stage(heads, patch=14)
    assert [value.name for value in model.graph.output] == ["depth", "confidence"]
    assert not scene_spec(network.preset).gaussians


def test_command_says_what_is_wrong_and_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("these are not weights")
    result = CliRunner().invoke(app, [str(tmp_path / "text"), str(tmp_path / "bundle")])
    assert result.exit_code == 2
    assert "neither safetensors nor a PyTorch checkpoint" in result.stderr
    save_checkpoint(random_network(), tmp_path / "own")
    result = CliRunner().invoke(app, [str(tmp_path / "own"), str(tmp_path / "bundle"), "--overlap", "8"])
    assert result.exit_code == 2
    (tmp_path / "list.json").write_text("[1]")
    accuracy = ["--accuracy", str(tmp_path / "list.json")]
    result = CliRunner().invoke(app, [str(tmp_path / "own"), str(tmp_path / "bundle"), *accuracy])
    assert (result.exit_code, "a JSON object was needed" in result.stderr.replace("\n", " ")) == (2, True)
    assert not (tmp_path / "bundle").exists()

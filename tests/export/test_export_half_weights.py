"""Weights in half the bits compute what the rounded float32 weights compute."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from bathyscope_export.half_weights import halve_weights
from bathyscope_export.weights import externalise
from bathyscope_train.model.half_precision import round_to_bfloat16


def product(weights: np.ndarray) -> onnx.ModelProto:
    """y = x W + b with a W that is large and a b that is small."""
    rows, columns = weights.shape
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["p"]), helper.make_node("Add", ["p", "b"], ["y"])],
        "product",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", rows])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", columns])],
        [numpy_helper.from_array(weights, "w"), numpy_helper.from_array(np.full(columns, 0.1, np.float32), "b")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def written(model: onnx.ModelProto, folder: Path) -> ort.InferenceSession:
    externalise([model], folder / "weights.bin")
    (folder / "graph.onnx").write_bytes(model.SerializeToString())
    return ort.InferenceSession(folder / "graph.onnx")


def test_rounded_weights_take_half_the_room_and_give_the_same_numbers(tmp_path: Path) -> None:
    layer = nn.Linear(64, 48)
    round_to_bfloat16(layer)
    weights = np.ascontiguousarray(layer.weight.detach().numpy().T)
    model = product(weights)
    halve_weights(model)
    session = written(model, tmp_path)
    assert (tmp_path / "weights.bin").stat().st_size == 2 * weights.size
    x = np.random.default_rng(0).normal(size=(5, 64)).astype(np.float32)
    np.testing.assert_allclose(session.run(None, {"x": x})[0], x @ weights + 0.1, atol=1e-6)


def test_weights_that_would_lose_bits_stay_as_they_are(tmp_path: Path) -> None:
    weights = np.random.default_rng(1).normal(size=(64, 48)).astype(np.float32)
    model = product(weights)
    halve_weights(model)
    written(model, tmp_path)
    assert (tmp_path / "weights.bin").stat().st_size == 4 * weights.size


def test_rounding_keeps_vectors_and_moves_matrices_by_less_than_a_bit() -> None:
    layer = nn.Linear(64, 48)
    weight, bias = layer.weight.detach().clone(), layer.bias.detach().clone()
    round_to_bfloat16(layer)
    assert torch.equal(layer.bias, bias)
    assert not torch.equal(layer.weight, weight)
    assert (layer.weight.detach() / weight - 1).abs().max().item() <= 2**-8

"""Which files an ONNX graph refers to: every place in which the format can hide a tensor."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import AttributeProto, FunctionProto, GraphProto, ModelProto, NodeProto, TensorProto, helper

from bathyscope.errors import BundleError
from bathyscope.external_data import external_locations


def external(location: str) -> TensorProto:
    tensor = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[2], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", location), ("offset", "0"), ("length", "8")):
        tensor.external_data.add(key=key, value=value)
    return tensor


def node(*attributes: AttributeProto) -> NodeProto:
    made = NodeProto(op_type="Constant", output=["y"])
    made.attribute.extend(attributes)
    return made


def graph(*nodes: NodeProto, weights: tuple[TensorProto, ...] = ()) -> GraphProto:
    return helper.make_graph(list(nodes), "g", [], [], initializer=list(weights))


def model(main: GraphProto) -> ModelProto:
    return helper.make_model(main)


def in_subgraph(depth: int) -> ModelProto:
    inner = graph(weights=(external("hidden"),))
    for _ in range(depth):
        inner = graph(node(AttributeProto(name="then_branch", type=AttributeProto.GRAPH, g=inner)))
    return model(inner)


def in_function() -> ModelProto:
    made = model(graph())
    attribute = AttributeProto(name="value", type=AttributeProto.TENSOR, t=external("hidden"))
    made.functions.append(FunctionProto(name="f", domain="d", node=[node(attribute)]))
    return made


def in_training_info() -> ModelProto:
    made = model(graph())
    made.training_info.add().algorithm.CopyFrom(graph(weights=(external("hidden"),)))
    return made


def in_sparse_initializer(part: str) -> ModelProto:
    made = model(graph())
    getattr(made.graph.sparse_initializer.add(), part).CopyFrom(external("hidden"))
    return made


def in_attribute(**fields: object) -> ModelProto:
    attribute = AttributeProto(name="a")
    for name, value in fields.items():
        if name in ("tensors", "graphs", "sparse_tensors"):
            getattr(attribute, name).append(value)
        else:
            getattr(attribute, name).CopyFrom(value)
    return model(graph(node(attribute)))


def sparse() -> onnx.SparseTensorProto:
    return onnx.SparseTensorProto(values=external("hidden"))


PLACES: dict[str, Callable[[], ModelProto]] = {
    "initializer": lambda: model(graph(weights=(external("hidden"),))),
    "attribute tensor": lambda: in_attribute(t=external("hidden")),
    "attribute tensors": lambda: in_attribute(tensors=external("hidden")),
    "attribute graphs": lambda: in_attribute(graphs=graph(weights=(external("hidden"),))),
    "attribute sparse tensor": lambda: in_attribute(sparse_tensor=sparse()),
    "attribute sparse tensors": lambda: in_attribute(sparse_tensors=sparse()),
    "subgraph": lambda: in_subgraph(1),
    "subgraph of a subgraph": lambda: in_subgraph(4),
    "function": in_function,
    "training info": in_training_info,
    "sparse values": lambda: in_sparse_initializer("values"),
    "sparse indices": lambda: in_sparse_initializer("indices"),
}


@pytest.mark.parametrize("build", PLACES.values(), ids=PLACES)
def test_an_external_tensor_is_found_wherever_it_hides(tmp_path: Path, build: Callable[[], ModelProto]) -> None:
    path = tmp_path / "graph.onnx"
    path.write_bytes(build().SerializeToString())
    assert external_locations(path) == {"hidden"}


def test_all_locations_are_collected_and_inner_weights_have_none(tmp_path: Path) -> None:
    inner = helper.make_tensor("inner", TensorProto.FLOAT, [2], [1.0, 2.0])
    path = tmp_path / "graph.onnx"
    path.write_bytes(model(graph(weights=(external("a"), external("../b"), inner, external("a")))).SerializeToString())
    assert external_locations(path) == {"a", "../b"}


def test_every_location_counts_of_a_tensor_that_names_two(tmp_path: Path) -> None:
    tensor = external("first")
    tensor.external_data.add(key="location", value="second")
    path = tmp_path / "graph.onnx"
    path.write_bytes(model(graph(weights=(tensor,))).SerializeToString())
    assert external_locations(path) == {"first", "second"}


def test_an_external_tensor_without_a_name_is_no_file_of_the_bundle(tmp_path: Path) -> None:
    path = tmp_path / "graph.onnx"
    path.write_bytes(model(graph(weights=(external(""),))).SerializeToString())
    assert external_locations(path) == {""}


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_graph_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    data = model(graph(weights=(external("weights"),) * 20)).SerializeToString()
    path = tmp_path / "graph.onnx"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BundleError, match=r"graph\.onnx: not an ONNX graph"):
        external_locations(path)


def test_nesting_beyond_any_real_graph_is_refused_not_followed(tmp_path: Path) -> None:
    path = tmp_path / "graph.onnx"
    path.write_bytes(in_subgraph(30).SerializeToString())
    with pytest.raises(BundleError, match="nested deeper"):
        external_locations(path)


@pytest.mark.parametrize(
    "data",
    [b"not a protobuf at all", b"\x3b", b"\x80" * 20, b"\x3a\xff\xff\xff\xff\x0f", b"\x3a"],
    ids=["text", "group", "endless number", "length past the end", "no length"],
)
def test_what_is_no_protobuf_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "graph.onnx"
    path.write_bytes(data)
    with pytest.raises(BundleError, match="not an ONNX graph"):
        external_locations(path)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_do_worse_than_a_bundle_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.onnx"
    path.write_bytes(data)
    with suppress(BundleError):
        assert isinstance(external_locations(path), set)

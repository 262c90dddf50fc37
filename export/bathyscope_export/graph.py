"""Trace a stage of a network to an ONNX graph with dynamic frames, height and width."""

import contextlib
import io
import warnings
from typing import Any

import onnx
import onnx_ir
import onnx_ir.passes.common as passes
import torch
from onnxscript import optimizer
from torch.export import Dim

from bathyscope_export.attention import check_linear_attention
from bathyscope_export.stages import Stage
from bathyscope_train.model.attention import fused_for_onnx

OPSET = 20
"""The newest operator set that every supported runtime reads."""

_SMALLEST_SIDE, _LARGEST_SIDE, _MOST_FRAMES = 3, 512, 4096


def export_stage(stage: Stage, *, patch: int) -> onnx.ModelProto:
    """The graph of a stage: checked for linear attention, named axes, nothing in it but computation.

    Args:
        stage: From :func:`~bathyscope_export.stages.split`; its module in evaluation mode.
        patch: Side of a patch in pixels.

    Raises:
        BundleError: If the traced graph holds attention that is quadratic in memory.
    """
    with torch.no_grad(), fused_for_onnx(), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        exported = torch.export.export(
            stage.module,
            stage.arguments,
            dynamic_shapes=_dynamic_shapes(stage, patch),
            strict=False,
            prefer_deferred_runtime_asserts_over_guards=True,
        )
        program = torch.onnx.export(
            exported,
            dynamo=True,
            opset_version=OPSET,
            input_names=stage.inputs,
            output_names=stage.outputs,
            optimize=False,
            verbose=False,
        )
    assert program is not None
    _simplify(program.model)
    model = program.model_proto
    check_linear_attention(model, stage.role)
    _tidy(model, stage)
    onnx.checker.check_model(model)
    return model


def _simplify(model: onnx_ir.Model) -> None:
    """Fold constants, drop what is unused or there twice: exact steps only.

    The exporter's own optimiser also rewrites patterns, a third of its time, and takes any constant below about 1e-8
    for zero: the epsilon under a square root goes, and 0 / 0 comes.
    """
    passes.InlinePass()(model)
    optimizer.fold_constants(model)
    for step in (
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.OutputFixPass(),
        passes.NameFixPass(),
        passes.ShapeInferencePass(),
    ):
        step(model)


def _dynamic_shapes(stage: Stage, patch: int) -> tuple[Any, ...]:
    if stage.shapes is not None:
        return stage.shapes
    frames = Dim("frames", min=1, max=_MOST_FRAMES)
    rows, columns = (Dim(name, min=_SMALLEST_SIDE, max=_LARGEST_SIDE) for name in ("rows", "columns"))
    height, width = patch * rows, patch * columns
    known: dict[str, dict[int, Any]] = {
        "images": {0: frames, 2: height, 3: width},
        "depth": {0: frames, 1: height, 2: width},
        "camera": {0: frames},
        "focal": {},
    }
    kinds = {"tokens": {0: frames, 1: rows, 2: columns}, "stem": {0: frames, 2: Dim.DYNAMIC, 3: Dim.DYNAMIC}}
    shapes = [known[name] if name in known else kinds[name.split("_")[0]] for name in stage.inputs]
    if stage.role != "heads":
        return tuple(shapes)
    return shapes[0], tuple(shapes[1:])  # the heads take their features as one tuple


def axes(name: str) -> tuple[str, ...]:
    """Names of the axes of an input or output; a name that is a number of channels is left as it is."""
    kind, _, index = name.partition("_")
    if name == "focal":
        return ("",)
    if name in ("depth", "confidence", "refined_depth", "values"):
        return ("frames", "height", "width")
    if name in ("images", "gaussians"):
        return ("frames", "", "height", "width")
    if kind == "tokens":
        return ("frames", "rows", "columns", "")
    if kind in ("stem", "path", "level"):
        return ("frames", "", f"height_{index}", f"width_{index}")
    return ("frames", "")


def _tidy(model: onnx.ModelProto, stage: Stage) -> None:
    """Drop inputs that nothing reads, the tracer's notes (they name files of this machine) and its axis names."""
    graph = model.graph
    read = {name for node in graph.node for name in node.input}
    for value in [value for value in graph.input if value.name not in read]:
        graph.input.remove(value)
    for value in (*graph.input, *graph.output):
        for axis, dimension in zip(axes(value.name), value.type.tensor_type.shape.dim, strict=True):
            if axis and not dimension.HasField("dim_value"):
                dimension.dim_param = axis
    del graph.value_info[:]
    for part in (model, graph, *graph.node, *graph.initializer, *graph.input, *graph.output):
        part.ClearField("doc_string")
        part.ClearField("metadata_props")
    for node in graph.node:
        node.ClearField("name")
    model.producer_name, model.producer_version = "bathyscope", ""
    graph.name = stage.role

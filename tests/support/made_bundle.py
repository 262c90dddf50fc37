"""A bundle whose answer is known: its graphs are written here, node by node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bathyscope.bundle import Bundle, BundleManifest, hash_file, write_manifest

onnx: Any = pytest.importorskip("onnx")
helper = onnx.helper
FLOAT = 1


def graph(path: Path, nodes: list[Any], inputs: dict[str, list[Any]], outputs: dict[str, list[Any]]) -> None:
    def infos(shapes: dict[str, list[Any]]) -> list[Any]:
        return [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in shapes.items()]

    model = helper.make_model(
        helper.make_graph(nodes, path.stem, infos(inputs), infos(outputs)),
        opset_imports=[helper.make_opsetid("", 20)],
        ir_version=9,
    )
    onnx.save(model, path)


def constant(name: str, values: Any, kind: int = FLOAT) -> Any:
    array = np.asarray(values)
    tensor = helper.make_tensor(name, kind, array.shape, array.reshape(-1).tolist())
    return helper.make_node("Constant", [], [name], value=tensor)


IMAGES = ["t", 3, "h", "w"]
MAPS = ["t", 1, "h", "w"]


def write_bundle(folder: Path, *, poisoned: bool = False, renamed: bool = False) -> Bundle:
    """depth = 1 + mean colour; the backbone gives that mean, the cameras see the mean depth as a shift along z."""
    mean = helper.make_node("ReduceMean", ["images", "axes"], ["grey"], keepdims=1)
    graph(
        folder / "backbone.onnx",
        [constant("axes", [1], 7), mean],
        {"images": IMAGES},
        {"grey": MAPS},
    )
    heads = [
        constant("axes", [1], 7),
        constant("one", [np.nan if poisoned else 1.0]),
        constant("repeats", [1, 12, 1, 1], 7),
        helper.make_node("Squeeze", ["grey", "axes"], ["flat"]),
        helper.make_node("Add", ["flat", "one"], ["depth"]),
        helper.make_node("Mul", ["depth", "one"], ["confidence"]),
        helper.make_node("Tile", ["grey", "repeats"], ["gaussians"]),
    ]
    dense = {"depth": ["t", "h", "w"], "confidence": ["t", "h", "w"], "gaussians": ["t", 12, "h", "w"]}
    graph(folder / "heads.onnx", heads, {"grey": MAPS}, dense)
    cameras = [
        constant("axes", [1, 2], 7),
        constant("unit", [[0, 0, 1, 0, 0, 0, 0, 0, 0]]),
        constant("rest", [[0, 0, 0, 0, 0, 0, 1, 0.9, 1.1]]),
        helper.make_node("ReduceMean", ["depth", "axes"], ["shift"], keepdims=0),
        constant("last", [1], 7),
        helper.make_node("Unsqueeze", ["shift", "last"], ["column"]),
        helper.make_node("Mul", ["column", "unit"], ["moved"]),
        helper.make_node("Add", ["moved", "rest"], ["pose_encoding"]),
    ]
    graph(folder / "cameras.onnx", cameras, {"depth": ["t", "h", "w"]}, {"pose_encoding": ["t", 9]})
    (folder / "weights.bin").write_bytes(b"")
    names = ("backbone.onnx", "heads.onnx", "cameras.onnx", "weights.bin")
    manifest = {
        "name": "made",
        "version": "1",
        "preset": "made",
        "graphs": {
            "backbone": {"file": "backbone.onnx", "inputs": ["images"], "outputs": ["gray" if renamed else "grey"]},
            "heads": {"file": "heads.onnx", "inputs": ["grey"], "outputs": ["depth", "confidence", "gaussians"]},
            "cameras": {"file": "cameras.onnx", "inputs": ["depth"], "outputs": ["pose_encoding"]},
        },
        "weights": "weights.bin",
        "files": {name: hash_file(folder / name).model_dump() for name in names},
        "input": {"patch": 14, "pixels": 28 * 42, "window": 4, "overlap": 1},
        "scene": {"pixel_centre": 0.5, "focal_epsilon": 0, "activation": "footprint", "sh_degree": 0},
        "licence": "Apache-2.0",
        "research_only": False,
    }
    write_manifest(folder, BundleManifest.model_validate(manifest))
    return Bundle.open(folder)


def write_video_bundle(folder: Path, video: dict[str, Any], window: int = 1, overlap: int = 0) -> Bundle:
    """values = mean colour of each pixel, or 0 if that is more: the backbone gives that mean, the heads hand it on."""
    folder.mkdir(parents=True, exist_ok=True)
    mean = helper.make_node("ReduceMean", ["images", "axes"], ["grey"], keepdims=1)
    graph(folder / "backbone.onnx", [constant("axes", [1], 7), mean], {"images": IMAGES}, {"grey": MAPS})
    heads = [constant("axes", [1], 7), helper.make_node("Squeeze", ["grey", "axes"], ["flat"])]
    heads.append(helper.make_node("Relu", ["flat"], ["values"]))
    graph(folder / "heads.onnx", heads, {"grey": MAPS}, {"values": ["t", "h", "w"]})
    (folder / "weights.bin").write_bytes(b"")
    names = ("backbone.onnx", "heads.onnx", "weights.bin")
    manifest = {
        "name": "made video",
        "version": "1",
        "preset": "made",
        "kind": "video",
        "graphs": {
            "backbone": {"file": "backbone.onnx", "inputs": ["images"], "outputs": ["grey"]},
            "heads": {"file": "heads.onnx", "inputs": ["grey"], "outputs": ["values"]},
        },
        "weights": "weights.bin",
        "files": {name: hash_file(folder / name).model_dump() for name in names},
        "input": {"patch": 14, "pixels": 28 * 42, "window": window, "overlap": overlap},
        "video": video,
        "licence": "Apache-2.0",
        "research_only": False,
    }
    write_manifest(folder, BundleManifest.model_validate(manifest))
    return Bundle.open(folder)

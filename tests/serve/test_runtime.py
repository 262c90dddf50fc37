"""Running a bundle's graphs: names, chunks, threads, and refusals. The graphs are written here, node by node."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bathyscope.bundle import Bundle, BundleManifest, hash_file, write_manifest
from bathyscope.errors import BundleError, GeometryError
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.runtime import OnnxModel

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


def images(frames: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(frames, 3, 28, 42)).astype(np.float32)


@pytest.mark.parametrize("frames", [1, 4, 5])
def test_the_graphs_are_fed_by_name_and_heads_in_chunks(tmp_path: Path, frames: int) -> None:
    model = OnnxModel(write_bundle(tmp_path), EngineSettings(head_chunk=2, threads=1))
    seen = images(frames)
    maps = model.predict(seen)
    np.testing.assert_allclose(maps.depth, 1 + seen.mean(1), atol=1e-5)
    np.testing.assert_allclose(maps.gaussians, np.repeat(seen.mean(1)[:, None], 12, 1), atol=1e-5)
    np.testing.assert_allclose(maps.pose_encoding[:, 2], maps.depth.mean((1, 2)), atol=1e-4)
    np.testing.assert_allclose(maps.pose_encoding[:, 6:], np.tile([1, 0.9, 1.1], (frames, 1)), atol=1e-6)


def test_every_chunk_passes_a_checkpoint_that_can_stop_the_run(tmp_path: Path) -> None:
    model = OnnxModel(write_bundle(tmp_path), EngineSettings(head_chunk=1, threads=1))
    passed = []

    def checkpoint() -> None:
        passed.append(1)
        if len(passed) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        model.predict(images(6), checkpoint)


def test_threads_share_one_model(tmp_path: Path) -> None:
    model = OnnxModel(write_bundle(tmp_path), EngineSettings(threads=1))
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda seed: model.predict(images(3, seed)), range(8)))
    for seed, maps in enumerate(results):
        np.testing.assert_allclose(maps.depth, 1 + images(3, seed).mean(1), atol=1e-5)


def test_outputs_that_are_not_finite_are_an_error(tmp_path: Path) -> None:
    model = OnnxModel(write_bundle(tmp_path, poisoned=True), EngineSettings(threads=1))
    with pytest.raises(GeometryError, match=r"depth has .* not finite"):
        model.predict(images(2))


def test_a_manifest_whose_names_are_not_the_graphs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=r"gives \['grey'\]; the manifest says"):
        OnnxModel(write_bundle(tmp_path, renamed=True), EngineSettings(threads=1))


def test_a_file_that_is_no_graph_is_refused(tmp_path: Path) -> None:
    bundle = write_bundle(tmp_path)
    (tmp_path / "heads.onnx").write_bytes(b"\x08\x07garbage")
    with pytest.raises(BundleError, match="cannot load this graph"):
        OnnxModel(bundle, EngineSettings(threads=1))


def test_an_input_that_a_graph_cannot_take_names_the_graph(tmp_path: Path) -> None:
    model = OnnxModel(write_bundle(tmp_path), EngineSettings(threads=1))
    with pytest.raises(BundleError, match=r"backbone\.onnx failed on \(2, 4, 28, 42\)"):
        model.predict(np.zeros((2, 4, 28, 42), np.float32))

"""Running a bundle's graphs: names, chunks, threads, and refusals. See ``made_bundle``."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from made_bundle import write_bundle

from bathyscope.errors import BundleError, GeometryError
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.runtime import OnnxModel


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

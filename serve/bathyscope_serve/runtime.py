"""Run the graphs of a bundle with ONNX Runtime: RGB frames in, raw maps and pose encodings out."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from bathyscope.bundle import Bundle, BundleManifest, GraphSpec, Role
from bathyscope.engines import keep_going
from bathyscope.errors import BundleError, GeometryError
from bathyscope.scene import WindowMaps
from bathyscope_serve.engine_settings import EngineSettings

F32 = NDArray[np.float32]
Tensors = dict[str, NDArray[Any]]


class OnnxGraphs:
    """The graphs of a bundle, loaded.

    Raises:
        BundleError: If ONNX Runtime cannot load a graph, or its inputs and outputs are not those of the manifest.
    """

    def __init__(self, bundle: Bundle, settings: EngineSettings) -> None:
        self._manifest: BundleManifest = bundle.manifest
        self._chunk = settings.head_chunk
        self._sessions = {
            role: _load(bundle, role, session_options(settings.threads, reuse=role != "cameras"))
            for role in bundle.manifest.graphs
        }

    def run(self, role: Role, known: Tensors) -> Tensors:
        """Outputs of a graph for what is known so far.

        Raises:
            BundleError: If the graph fails on this input.
        """
        graph = self._graph(role)
        try:
            values = self._sessions[role].run(list(graph.outputs), {name: known[name] for name in graph.inputs})
        except Exception as error:  # ONNX Runtime raises classes of its own that share no base
            raise BundleError(f"graph {graph.file} failed on {known['images'].shape} images: {error}") from error
        return dict(zip(graph.outputs, values, strict=True))

    def heads(self, known: Tensors, checkpoint: Callable[[], None]) -> Tensors:
        """Dense heads, a few frames at a time: their activations are the other peak of memory."""
        names = self._graph("heads").inputs
        frames = len(known["images"])
        parts: list[Tensors] = []
        for start in range(0, frames, self._chunk):
            checkpoint()
            parts.append(self.run("heads", {name: known[name][start : start + self._chunk] for name in names}))
        return {name: np.concatenate([part[name] for part in parts]) for name in self._graph("heads").outputs}

    def _graph(self, role: Role) -> GraphSpec:
        return self._manifest.graphs[role]


class OnnxModel:
    """A scene network: backbone, heads in chunks of frames, cameras.

    Raises:
        BundleError: See :class:`OnnxGraphs`.
    """

    def __init__(self, bundle: Bundle, settings: EngineSettings) -> None:
        self._graphs = OnnxGraphs(bundle, settings)

    def predict(
        self, images: F32, checkpoint: Callable[[], None] = keep_going, *, focal: float | None = None
    ) -> WindowMaps:
        """See :class:`~bathyscope.engines.WindowModel`.

        Raises:
            GeometryError: If the outputs are not finite or of the wrong shape.
            BundleError: If a graph fails on this input.
        """
        known: Tensors = {"images": np.ascontiguousarray(images, np.float32)}
        known["focal"] = np.array([focal or 0.0], np.float32)
        known |= self._graphs.run("backbone", known)
        checkpoint()
        known |= self._graphs.heads(known, checkpoint)
        checkpoint()
        known |= self._graphs.run("cameras", known)
        t, h, w = len(images), *images.shape[2:]
        if known["depth"].shape != (t, h, w):
            raise GeometryError(f"the network's depth has shape {known['depth'].shape}, {(t, h, w)} was needed")
        gaussians = known.get("gaussians")
        return WindowMaps(
            depth=np.asarray(known.get("refined_depth", known["depth"]), np.float32),
            confidence=np.asarray(known["confidence"], np.float32),
            gaussians=None if gaussians is None else np.asarray(gaussians, np.float32),
            pose_encoding=np.asarray(known["pose_encoding"], np.float32),
        )


class OnnxVideoModel:
    """A video network: backbone on the whole window, heads in chunks of its frames.

    Raises:
        BundleError: See :class:`OnnxGraphs`.
    """

    def __init__(self, bundle: Bundle, settings: EngineSettings) -> None:
        self._graphs = OnnxGraphs(bundle, settings)

    def values(self, images: F32, checkpoint: Callable[[], None] = keep_going) -> F32:
        """See :class:`~bathyscope.engines.VideoModel`.

        Raises:
            GeometryError: If the values are not finite, negative, or not one map a frame.
            BundleError: If a graph fails on this input.
        """
        known: Tensors = {"images": np.ascontiguousarray(images, np.float32)}
        known |= self._graphs.run("backbone", known)
        checkpoint()
        values = np.asarray(self._graphs.heads(known, checkpoint)["values"], np.float32)
        if values.ndim != 3 or len(values) != len(images):
            raise GeometryError(f"the network gave values of shape {values.shape} for {len(images)} frames")
        bad = int((~np.isfinite(values) | (values < 0)).sum())
        if bad:
            raise GeometryError(f"{bad} of the network's values are negative or not finite")
        return values


def session_options(threads: int | None, *, reuse: bool = True) -> ort.SessionOptions:
    """Options for clips of any size beside other work: no spinning, no memory arena that only grows.

    Args:
        threads: Threads of an operator; all cores unless given.
        reuse: Plan which results may share memory. For the thousands of small results of a camera solver that plan
            takes seconds (it grows with the square of their number) and saves 27 MB.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.enable_cpu_mem_arena = False
    options.enable_mem_pattern = False
    options.enable_mem_reuse = reuse
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options


def _load(bundle: Bundle, role: Role, options: ort.SessionOptions) -> ort.InferenceSession:
    graph, path = bundle.manifest.graphs[role], bundle.graph(role)
    try:
        session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises classes of its own that share no base
        raise BundleError(f"{path}: ONNX Runtime {ort.__version__} cannot load this graph: {error}") from error
    found = {entry.name for entry in session.get_inputs()}, {entry.name for entry in session.get_outputs()}
    if found[0] != set(graph.inputs) or not set(graph.outputs) <= found[1]:
        raise BundleError(
            f"{path}: takes {sorted(found[0])} and gives {sorted(found[1])}; the manifest says {list(graph.inputs)} "
            f"and {list(graph.outputs)}"
        )
    return session

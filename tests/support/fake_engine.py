"""An engine whose result is known in closed form, for tests of what surrounds engines."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bathyscope.bundle import Bundle, BundleManifest
from bathyscope.engines import DepthOptions
from bathyscope.errors import ClipError
from bathyscope.result import FrameDepth, PointAgreement, ResultMeta

NOT_A_CLIP = b"this is not a clip"
BREAKS = b"breaks the engine"


def fake_bundle(folder: Path = Path("fake")) -> Bundle:
    sha = "0" * 64
    graph = {"file": "graph.onnx", "inputs": ["images"], "outputs": ["x"]}
    manifest = BundleManifest.model_validate(
        {
            "name": "fake",
            "version": "1",
            "preset": "tiny",
            "graphs": dict.fromkeys(("backbone", "heads", "cameras"), graph),
            "weights": "weights.data",
            "files": {name: {"sha256": sha, "bytes": 1} for name in ("graph.onnx", "weights.data")},
            "input": {"patch": 14, "pixels": 1000, "window": 4, "overlap": 1},
            "scene": {"pixel_centre": 0.5, "focal_epsilon": 0, "activation": "footprint", "sh_degree": 0},
            "licence": "Apache-2.0",
            "research_only": False,
        }
    )
    return Bundle(folder, manifest, "f" * 64)


def plane(t: int, size: tuple[int, int]) -> FrameDepth:
    """Frame t of a camera that moves 0.1 to the right in front of a slanted plane; the left column is not valid."""
    h, w = size
    valid = np.ones((h, w), bool)
    valid[:, 0] = False
    depth = np.tile(np.linspace(1.0, 2.0, w, dtype=np.float32), (h, 1)) * valid
    pose = np.eye(4)
    pose[0, 3] = 0.1 * t
    intrinsics = np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1]], np.float64)
    return FrameDepth(t, t / 25, depth, (valid * 1.0).astype(np.float32), valid, pose, intrinsics)


class FakeRun:
    def __init__(self, engine: "FakeEngine", source: Path, options: DepthOptions, name: str) -> None:
        self._engine, self._source, self._options, self._name = engine, source, options, name
        self.closed = False
        self.yielded = 0
        self.frame_count: int | None = engine.frames

    def __iter__(self) -> Iterator[FrameDepth]:
        content = b""
        if self._source.is_file():
            with self._source.open("rb") as file:
                content = file.read(64)
        if content.startswith(NOT_A_CLIP):
            raise ClipError(f"{self._name}: not a video that can be read")
        if content.startswith(BREAKS):
            raise RuntimeError("secret inner detail")
        for t in range(0, self._engine.frames, self._options.stride):
            time.sleep(self._engine.delay_s)
            self.yielded += 1
            yield plane(t, self._engine.size)

    def meta(self) -> ResultMeta:
        return ResultMeta(
            name=self._name,
            depth=self._options.depth,
            bundle=self._engine.bundle.id,
            settings=json.loads(self._options.model_dump_json()),
            agreement=PointAgreement(difference=0.125, points=200, frames=3),
            timings_s={"decode": 0.25},
        )

    def close(self) -> None:
        self.closed = True


class FakeEngine:
    def __init__(self, frames: int = 4, size: tuple[int, int] = (24, 32), delay_s: float = 0.0) -> None:
        self.frames, self.size, self.delay_s = frames, size, delay_s
        self.bundle = fake_bundle()
        self.runs: list[FakeRun] = []
        self.warmed = False

    def warm_up(self) -> None:
        self.warmed = True

    def run(self, source: Path, options: DepthOptions = DepthOptions(), *, name: str | None = None) -> FakeRun:
        run = FakeRun(self, source, options, name or source.stem)
        self.runs.append(run)
        return run

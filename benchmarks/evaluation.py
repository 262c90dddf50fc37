"""Time an evaluation beside inference, and print one line of JSON: milliseconds per frame and peak memory.

The sequence is made up in memory, frame by frame, so nothing is read: a real data set adds the decoding of its truth,
up to three times a frame (once for each pass). Truth has 1280x1024 pixels of which ``--share`` are known; predictions
lie on disk at the size that is asked for, as they do in a real evaluation.

    python benchmarks/evaluation.py [--frames 100] [--protocol paper] [--prediction 1024x1280] [--poses]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bathyscope_train.evaluation.estimates import open_estimates, store_estimates
from bathyscope_train.evaluation.measure import measure
from bathyscope_train.evaluation.protocols import PROTOCOLS, named_protocol
from bathyscope_train.evaluation.sequences import Crop, Unit
from bathyscope_train.systems.system import FrameEstimate, SystemInfo

SIZE = (1024, 1280)


@dataclass
class MadeUp:
    """A wavy surface that changes a little from frame to frame."""

    frames: int
    share: float
    poses: bool
    name: str = "made-up"
    size: tuple[int, int] = SIZE
    depth_unit: Unit = "mm"
    depth_range: tuple[float, float] | None = (1e-3, 150.0)
    published_crop: Crop | None = None
    groups: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pose_unit: Unit | None = "mm"

    def __post_init__(self) -> None:
        v, u = np.mgrid[0 : self.size[0], 0 : self.size[1]].astype(np.float32)
        self.surface = 70 + 20 * np.sin(u / 200) * np.cos(v / 150)
        self.known = np.random.default_rng(0).random(self.size) < self.share

    @property
    def frame_names(self) -> Sequence[str]:
        return [str(index) for index in range(self.frames)]

    @property
    def intrinsics(self) -> np.ndarray:
        return np.array([[1050.0, 0, 640], [0, 1045, 512], [0, 0, 1]])

    @property
    def world_from_camera(self) -> np.ndarray | None:
        return np.tile(np.eye(4), (self.frames, 1, 1)) if self.poses else None

    def image(self, index: int) -> np.ndarray:
        return np.full((*self.size, 3), 128, np.uint8)

    def truth(self, index: int) -> np.ndarray:
        return np.where(self.known, self.surface + np.float32(0.01 * index), np.float32(0))


def estimates(sequence: MadeUp, size: tuple[int, int]) -> Iterator[FrameEstimate]:
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32)
    values = (1 + 0.3 * np.sin(u / size[1] * 6) * np.cos(v / size[0] * 7)).astype(np.float32)
    for index in range(sequence.frames):
        yield FrameEstimate(index, values + np.float32(0.001 * index), np.ones(size, np.bool_))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--protocol", choices=list(PROTOCOLS), default="paper")
    parser.add_argument("--prediction", default="1024x1280", help="height x width of the predictions")
    parser.add_argument("--share", type=float, default=0.8, help="share of pixels with true depth")
    parser.add_argument("--poses", action="store_true", help="with true poses, so that TAE is measured too")
    given = parser.parse_args()
    height, width = (int(number) for number in given.prediction.split("x"))
    sequence = MadeUp(given.frames, given.share, given.poses)
    making = time.process_time()
    for index in range(5):
        sequence.truth(index)
    making = (time.process_time() - making) / 5
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        info, shape = SystemInfo(name="made up", quantity="depth", scale="relative"), (given.frames, height, width)
        for _ in store_estimates(where, "benchmark", info, shape, estimates(sequence, (height, width))):
            pass
        stored = open_estimates(where, "benchmark")
        assert stored is not None
        wall, cpu = time.perf_counter(), time.process_time()
        found = measure(sequence, stored, named_protocol(given.protocol))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    assert found.outcome == "measured", found.outcome
    report = {
        "benchmark": "evaluation",
        "protocol": given.protocol,
        "frames": given.frames,
        "poses": given.poses,
        "truth": list(SIZE),
        "prediction": [height, width],
        "cpu_ms_per_frame": round(1e3 * cpu / given.frames, 1),
        "wall_ms_per_frame": round(1e3 * wall / given.frames, 1),
        "of_which_making_up_truth_ms": round(3e3 * making, 1),
        "minutes_for_1000_frames": round(wall / given.frames * 1000 / 60, 1),
        "peak_memory_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "threads": os.environ.get("OMP_NUM_THREADS", "default"),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()

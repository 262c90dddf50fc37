"""Time rendering with gradients, compare the two torch backends, and print one line of JSON.

Scenes are those of ``benchmarks/splat.py``: pixel-aligned Gaussians of a smooth surface, one for each pixel of 1, 3 or
16 source frames, rendered with colour (degree 0), depth and opacity into one view of 224 x 280. A run is a forward and
a backward pass with gradients for everything: means, rotations, scales, opacities, harmonics, pose and intrinsics.

Times are CPU times of one thread, the best of several runs; the backends take turns. ``reference`` is
``ReferenceRenderer`` in float32, plain torch and autograd. ``memory`` is the peak resident memory of a process of its
own that renders 16 views of a million Gaussians and goes back; ``before_mb`` is its peak once the scene is made.

    OMP_NUM_THREADS=1 python benchmarks/splat_backward.py [--quick]
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import time
from dataclasses import dataclass

import torch
from splat import FOCAL, HEIGHT, INTRINSICS, WIDTH, surface
from torch import Tensor

from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import CpuRenderer, ReferenceRenderer

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
VIEWS = 16


@dataclass(frozen=True)
class Timing:
    forward_ms: float
    backward_ms: float

    @property
    def both_ms(self) -> float:
        return self.forward_ms + self.backward_ms


class Task:
    """One scene, ``views`` cameras that move sideways, and a loss over all that is rendered."""

    def __init__(self, frames: int, views: int) -> None:
        scene = surface(frames)
        self.leaves = [torch.from_numpy(getattr(scene, name))[None].requires_grad_() for name in FIELDS]
        poses = torch.eye(4).repeat(1, views, 1, 1)
        poses[0, :, 0, 3] = -0.003 * torch.arange(views)
        self.poses = poses.requires_grad_()
        self.intrinsics = torch.from_numpy(INTRINSICS).float().repeat(1, views, 1, 1).requires_grad_()
        self.weight = torch.randn(1, views, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))

    def forward(self, renderer: CpuRenderer | ReferenceRenderer) -> Tensor:
        found = renderer.from_cameras(GaussianBatch(*self.leaves), self.poses, self.intrinsics, (HEIGHT, WIDTH))
        return ((found.image.sum(2) + found.depth + found.opacity) * self.weight).sum()

    def run(self, renderer: CpuRenderer | ReferenceRenderer) -> Timing:
        for leaf in (*self.leaves, self.poses, self.intrinsics):
            leaf.grad = None
        start = time.process_time()
        loss = self.forward(renderer)
        middle = time.process_time()
        loss.backward()
        return Timing(1e3 * (middle - start), 1e3 * (time.process_time() - middle))


def best(runs: list[Timing]) -> Timing:
    return min(runs, key=lambda run: run.both_ms)


def measure(frames: int, *, with_reference: bool) -> dict[str, object]:
    task = Task(frames, views=1)
    fast: list[Timing] = []
    slow: list[Timing] = []
    for turn in range(2 if with_reference else 1):
        fast += [task.run(CpuRenderer(threads=1)) for _ in range(4)]
        if with_reference and turn == 0:
            slow.append(task.run(ReferenceRenderer()))
    cpu = best(fast[1:])
    found: dict[str, object] = {
        "gaussians": frames * HEIGHT * WIDTH,
        "cpu": {name: round(ms, 1) for name, ms in vars(cpu).items()},
        "backward_to_forward": round(cpu.backward_ms / cpu.forward_ms, 2),
    }
    if slow:
        reference = best(slow)
        found["reference"] = {name: round(ms, 1) for name, ms in vars(reference).items()}
        found["ratio"] = round(reference.both_ms / cpu.both_ms, 1)
    return found


def memory(threads: int) -> dict[str, float]:
    """Peaks in MB of a process that renders 16 views of a million Gaussians and goes back."""
    task = Task(16, views=VIEWS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    task.run(CpuRenderer(threads=threads))
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "threads": threads,
        "views": VIEWS,
        "gaussians": 16 * HEIGHT * WIDTH,
        "peak_mb": round(after / 1024),
        "before_mb": round(before / 1024),
        "wall_s": round(wall, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smallest scene only, no memory")
    parser.add_argument("--memory", type=int, metavar="THREADS", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.memory:
        print(json.dumps(memory(arguments.memory)))
        return
    report: dict[str, object] = {
        "benchmark": "splat_backward",
        "size": [HEIGHT, WIDTH],
        "focal": FOCAL,
        "machine": platform.machine(),
    }
    scenes = [measure(frames, with_reference=frames < 16) for frames in ((1,) if arguments.quick else (1, 3, 16))]
    report["scenes"] = scenes
    report["lowest_ratio"] = min(scene["ratio"] for scene in scenes if "ratio" in scene)  # type: ignore[type-var]
    if not arguments.quick:
        report["memory"] = [
            json.loads(
                subprocess.run(
                    [sys.executable, __file__, "--memory", str(threads)], check=True, capture_output=True, text=True
                ).stdout
            )
            for threads in (1, 2)
        ]
    print(json.dumps(report))


if __name__ == "__main__":
    main()

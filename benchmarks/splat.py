"""Time the two splatting backends against each other and print one line of JSON.

Scenes are pixel-aligned Gaussians of a smooth surface: one for each pixel of each of 1, 3 or 16 source frames of
224 x 280, median scale 0.7 px, 35 % spread of the logarithm of the scale, opacity sigmoid(N(0.2, 1.2)), 0.4 % depth
noise. They are rendered with colour (degree 0), depth and opacity into one view of 224 x 280.

Times are CPU times of the one thread that renders, the best of several runs; the backends take turns, so that
whatever else the machine does meets both. ``first_call_s`` is the CPU time of the first rendering in a process of
its own, the import of numba included: with an empty kernel cache, and with a filled one.

    python benchmarks/splat.py [--quick]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bathyscope.gaussians import Gaussians
from bathyscope.splat import PreparedScene, Rendering, prepare, render

HEIGHT, WIDTH, FOCAL = 224, 280, 224.0
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
POSE = np.eye(4)
BACKENDS = ("numba", "numpy")

FIRST_CALL = """
import time
import numpy as np
from benchmarks_splat import surface, POSE, INTRINSICS
from bathyscope.splat import render
scene = surface(1)
start = time.process_time()
render(scene, POSE, INTRINSICS, (224, 280))
print(time.process_time() - start)
"""


@dataclass(frozen=True)
class Timing:
    prepare_ms: float
    render_ms: float
    depth_only_ms: float


def surface(frames: int, seed: int = 0) -> Gaussians:
    """The scene that ``frames`` cameras, moving sideways, predict of one smooth surface."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    a, b = u / WIDTH, v / HEIGHT
    smooth = 1 + 0.25 * np.sin(5 * a + 0.3) + 0.2 * np.cos(4 * b) + 0.1 * np.sin(13 * a) * np.cos(11 * b)
    count = frames * HEIGHT * WIDTH
    z = smooth * (1 + 0.004 * rng.standard_normal((frames, HEIGHT, WIDTH)))
    x = (u - WIDTH / 2) / FOCAL * z + 0.003 * np.arange(frames)[:, None, None]
    means = np.stack([x, (v - HEIGHT / 2) / FOCAL * z, z], -1).reshape(-1, 3)
    scales = 0.7 * z.reshape(-1, 1) / FOCAL * np.exp(0.35 * rng.standard_normal((count, 3)))
    opacities = 1 / (1 + np.exp(-rng.normal(0.2, 1.2, count)))
    arrays = (means, rng.standard_normal((count, 4)), scales, opacities, rng.standard_normal((count, 1, 3)))
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def cpu_ms(work: Callable[[], object]) -> float:
    start = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - start)


def view(scene: PreparedScene, *, colour: bool) -> Rendering:
    return render(scene, POSE, INTRINSICS, (HEIGHT, WIDTH), colour=colour)


def measure(frames: int, rounds: int) -> dict[str, Timing]:
    """Best times of both backends, in turns."""
    scene = surface(frames)
    prepared = {name: prepare(scene, backend=name) for name in BACKENDS}
    best = {name: [float("inf")] * 3 for name in BACKENDS}
    for name in BACKENDS:
        view(prepared[name], colour=True)
    for _ in range(rounds):
        for name in BACKENDS:
            for _ in range(5 if name == "numba" else 1):
                found = [
                    cpu_ms(lambda name=name: prepare(scene, backend=name)),
                    cpu_ms(lambda name=name: view(prepared[name], colour=True)),
                    cpu_ms(lambda name=name: view(prepared[name], colour=False)),
                ]
                best[name] = [min(pair) for pair in zip(best[name], found, strict=True)]
    return {name: Timing(*times) for name, times in best.items()}


def first_calls() -> dict[str, float]:
    """CPU seconds of the first rendering of a process, without and with compiled kernels on disk."""
    found = {}
    with tempfile.TemporaryDirectory() as cache:
        here = os.path.dirname(os.path.abspath(__file__))
        code = FIRST_CALL.replace("from benchmarks_splat", f"import sys; sys.path.insert(0, {here!r})\nfrom splat")
        for name in ("empty_cache", "filled_cache"):
            environment = os.environ | {"NUMBA_CACHE_DIR": cache}
            answer = subprocess.run(
                [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
            )
            found[name] = round(float(answer.stdout), 2)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smallest scene only, no first calls")
    quick = parser.parse_args().quick
    report: dict[str, object] = {"benchmark": "splat", "size": [HEIGHT, WIDTH], "machine": platform.machine()}
    scenes = []
    for frames in (1,) if quick else (1, 3, 16):
        timings = measure(frames, rounds=1 if frames == 16 else 2)
        fast, plain = timings["numba"], timings["numpy"]
        scenes.append(
            {
                "gaussians": frames * HEIGHT * WIDTH,
                **{name: {key: round(ms, 2) for key, ms in vars(t).items()} for name, t in timings.items()},
                "ratio": round(plain.render_ms / fast.render_ms, 1),
                "ratio_with_prepare": round(
                    (plain.render_ms + plain.prepare_ms) / (fast.render_ms + fast.prepare_ms), 1
                ),
            }
        )
    report["scenes"] = scenes
    report["lowest_ratio"] = min(scene["ratio"] for scene in scenes)  # type: ignore[type-var]
    if not quick:
        report["first_call_s"] = first_calls()
    print(json.dumps(report))


if __name__ == "__main__":
    main()

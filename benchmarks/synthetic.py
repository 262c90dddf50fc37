"""How fast one core renders clips, scene building included: python benchmarks/synthetic.py.

Rates are per second of processor time of this one thread, so that other loads on the machine count
less; the wall clock's rate stands beside them.

With ``--renderer torch --device cuda|cpu`` the renderer in torch is timed, on scenes that are drawn before the clock
starts (in training other processes draw them), and numba on the same scenes; ``ratio`` is torch's rate over numba's.
"""

import argparse
import json
import platform
import time
from statistics import median
from typing import get_args

import numpy as np

from bathyscope_train.data.synthetic import DOMAINS, Domain, render_clip
from bathyscope_train.data.synthetic.clip import ClipPlan, render_frame_of
from bathyscope_train.data.synthetic.domain import Family
from bathyscope_train.data.synthetic.optics import develop, form_image
from bathyscope_train.data.synthetic.plan_stream import PlanJob, PlanStream
from bathyscope_train.data.synthetic.shutter import image_motion


def rates(domain: Domain, seeds: range, frames: int, size: tuple[int, int]) -> tuple[list[float], list[float]]:
    """Frames a second of processor time and of wall time, one number a clip."""
    render_clip(seeds[0], domain, frames=1, size=size)  # compile
    processor, wall = [], []
    for seed in seeds:
        starts = time.process_time(), time.perf_counter()
        render_clip(seed, domain, frames=frames, size=size)
        processor.append(frames / (time.process_time() - starts[0]))
        wall.append(frames / (time.perf_counter() - starts[1]))
    return processor, wall


def plans_of(domain: Domain, clips: int, frames: int, size: tuple[int, int], takes: int) -> list[ClipPlan]:
    """Clips of one family, ``takes`` of each scene."""
    stream = PlanStream(PlanJob(domain, frames, size, takes))
    return stream.take(clips)


def torch_rate(plans: list[ClipPlan], device: str, *, at_once: int, compiled: bool) -> float:
    """Frames a second of wall time, of a second pass over the same clips."""
    import torch

    from bathyscope_train.data.synthetic.torch_clip import render_plans

    started = 0.0
    for _ in range(2):
        started = time.perf_counter()
        for start in range(0, len(plans), at_once):
            batch = render_plans(plans[start : start + at_once], device=device, compiled=compiled)
            del batch
        if device == "cuda":
            torch.cuda.synchronize()
    return sum(len(plan.scene_from_camera) for plan in plans) / (time.perf_counter() - started)


def numba_rate(plans: list[ClipPlan]) -> float:
    """Frames a second of wall time on one core, of planned clips."""
    render_planned(plans[0])
    started = time.perf_counter()
    for plan in plans:
        render_planned(plan)
    return sum(len(plan.scene_from_camera) for plan in plans) / (time.perf_counter() - started)


def render_planned(plan: ClipPlan) -> None:
    radiance, depth, _ = zip(*(render_frame_of(plan, k) for k in range(len(plan.scene_from_camera))), strict=True)
    motion = image_motion(np.stack(depth), plan.scene_from_camera, plan.intrinsics, plan.distortion)
    formed = form_image(np.stack(radiance), np.stack(depth), motion, float(plan.intrinsics[0, 0]), plan.sensor)
    develop(np.random.default_rng(0), formed, plan.sensor)


def compare(options: argparse.Namespace, size: tuple[int, int]) -> dict[str, object]:
    """Rates of the renderer in torch and of numba, family by family."""
    import torch

    name = torch.cuda.get_device_name() if options.device == "cuda" else f"cpu, {torch.get_num_threads()} threads"
    result: dict[str, object] = {"device": name, "compiled": options.compile, "at_once": options.at_once}
    seconds = {"torch": 0.0, "numba": 0.0}
    for family in get_args(Family):
        domain = DOMAINS[options.domain].model_copy(update={"families": {family: 1.0}})
        plans = plans_of(domain, options.clips, options.frames, size, options.takes)
        fast = torch_rate(plans, options.device, at_once=options.at_once, compiled=options.compile)
        slow = numba_rate(plans[: options.numba_clips])
        result[family] = {"torch": round(fast, 1), "numba": round(slow, 1), "ratio": round(fast / slow, 2)}
        seconds["torch"] += 1 / fast
        seconds["numba"] += 1 / slow
    rates = {which: round(len(get_args(Family)) / total, 1) for which, total in seconds.items()}
    return result | {"mean": rates | {"ratio": round(seconds["numba"] / seconds["torch"], 2)}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", choices=sorted(DOMAINS), default="source")
    parser.add_argument("--clips", type=int, default=6, help="clips of each family")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--height", type=int, default=128)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--renderer", choices=("numba", "torch"), default="numba")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of the renderer in torch")
    parser.add_argument("--compile", action="store_true", help="trace and shade by compiled code")
    parser.add_argument("--at-once", type=int, default=32, help="clips that torch renders together")
    parser.add_argument("--takes", type=int, default=4, help="clips of one scene, for torch")
    parser.add_argument("--numba-clips", type=int, default=4, help="clips that numba renders beside torch")
    options = parser.parse_args()
    size = (options.height, options.width)
    result: dict[str, object] = {
        "benchmark": "synthetic",
        "domain": options.domain,
        "size": size,
        "frames": options.frames,
        "clips": options.clips,
        "machine": platform.machine(),
    }
    if options.renderer == "torch":
        print(json.dumps(result | compare(options, size)))
        return
    every: list[float] = []
    domain = DOMAINS[options.domain]
    for family in get_args(Family):
        chosen = domain.model_copy(update={"families": {family: 1.0}})
        processor, wall = rates(chosen, range(options.clips), options.frames, size)
        every += [options.frames / rate for rate in processor]
        result[family] = {"fps_processor": round(median(processor), 1), "fps_wall": round(median(wall), 1)}
    result["fps_processor_mean"] = round(options.frames * len(every) / sum(every), 1)
    print(json.dumps(result))


if __name__ == "__main__":
    main()

"""Seconds of one step of the consistency optimisation by part, and how near the network comes to the matmul limit.

A step of a settings file is taken apart: windows are drawn (decode), the network runs forward, views are splatted, the
losses go back to what was rendered, splatting goes back to the Gaussians, the network goes back to its weights, AdamW
moves them. Parts are measured one window at a time and multiplied by the windows of a batch; each is the median of
several steps, in CPU time of all threads and in wall time. The matmul limit is what a large float32 product reaches on
the same threads; the network's share of it is its counted operations, forward and back, over its time.

    OMP_NUM_THREADS=1 python benchmarks/consistency.py configs/consistency-small.yaml data=FOLDER init=CHECKPOINT
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from bathyscope_train.consistency.batches import parts_of
from bathyscope_train.consistency.clip_step import ClipStep
from bathyscope_train.consistency.geometry import ClipGeometry
from bathyscope_train.consistency.objective import consistency_terms, weighted_sum
from bathyscope_train.consistency.parts import optimizer_groups, set_trainable, trained_groups
from bathyscope_train.consistency.rendering import render_clip
from bathyscope_train.consistency.settings import ConsistencySettings, load_consistency_settings
from bathyscope_train.consistency.start import load_initial, open_training_windows
from bathyscope_train.data.clip_loader import WindowLoader
from bathyscope_train.devices import choose_device, use_bfloat16
from bathyscope_train.losses.supervised import splatting
from bathyscope_train.model.gaussian_parameters import GaussianBatch

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
BACK = "network back"


class Clock:
    """CPU and wall seconds of named parts."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.cpu: dict[str, list[float]] = defaultdict(list)
        self.wall: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._settle()
        cpu, wall = time.process_time(), time.perf_counter()
        yield
        self._settle()
        self.cpu[name].append(time.process_time() - cpu)
        self.wall[name].append(time.perf_counter() - wall)

    def _settle(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def leaves_of(geometry: ClipGeometry) -> tuple[ClipGeometry, list[tuple[Tensor, Tensor]]]:
    """The same geometry cut off from the network, and each leaf with what it was cut from."""
    pairs = []

    def leaf(value: Tensor) -> Tensor:
        if not value.requires_grad:
            return value
        cut = value.detach().requires_grad_()
        pairs.append((cut, value))
        return cut

    assert geometry.gaussians is not None
    gaussians = GaussianBatch(*(leaf(getattr(geometry.gaussians, name)) for name in FIELDS))
    poses, intrinsics = leaf(geometry.world_from_camera), leaf(geometry.intrinsics)
    return ClipGeometry(leaf(geometry.depth), poses, intrinsics, gaussians), pairs


def one_window(step: ClipStep, part: tuple[Tensor, Tensor, Tensor | None], clock: Clock) -> None:
    """Forward and back through one window, part by part; gradients stay in the network."""
    images, inside, focal = part
    with clock.part("network forward"):
        geometry, before = step.geometry(images, inside, focal)
    cut, pairs = leaves_of(geometry)
    with clock.part("splat forward"):
        rendered = render_clip(cut, step.renderer, step.settings.loss.image)
    maps = {name: getattr(rendered, name) for name in ("depth", "opacity", "image", "image_opacity")}
    shown = {name: None if value is None else value.detach().requires_grad_() for name, value in maps.items()}
    with clock.part("losses"):
        terms = consistency_terms(
            replace(rendered, **shown), cut, before, images=images, inside=inside, settings=step.settings.loss
        )
        weighted_sum(terms, step.weights).backward()
    used = [(maps[name], value.grad) for name, value in shown.items() if value is not None and value.grad is not None]
    with clock.part("splat back"):
        torch.autograd.backward([value for value, _ in used], [gradient for _, gradient in used])
    reached = [(value, leaf.grad) for leaf, value in pairs if leaf.grad is not None]
    with clock.part(BACK):
        torch.autograd.backward([value for value, _ in reached], [gradient for _, gradient in reached])


def matmul_limit(device: torch.device, size: int = 1024, seconds: float = 1.0) -> float:
    """Operations a second of a large float32 product; the best of many."""
    a, b = (torch.rand(size, size, device=device) for _ in range(2))
    clock, end = Clock(device), time.perf_counter() + seconds
    while time.perf_counter() < end:
        with clock.part("product"):
            a @ b
    return 2 * size**3 / min(clock.wall["product"])


def measure(settings: ConsistencySettings, repeats: int) -> dict[str, object]:
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    device = choose_device(settings.device)
    torch.manual_seed(settings.seed)
    network = load_initial(settings.init, settings.preset).to(device)
    step = ClipStep(network, settings, splatting(device), autocast=use_bfloat16(settings.precision, device))
    groups = trained_groups(network, settings.parts)
    optimizer = torch.optim.AdamW(optimizer_groups(network, groups, settings))
    set_trainable(network, groups, settings.warmup_steps, settings)
    single = settings.model_copy(update={"accumulate": 1})
    clock, operations = Clock(device), 0
    with WindowLoader(open_training_windows(settings), batch=1, workers=0) as loader:
        for repeat in range(repeats + 1):
            if repeat == 1:  # the first compiles and warms up
                clock = Clock(device)
            optimizer.zero_grad(set_to_none=True)
            with clock.part("decode"):
                batch = next(loader)
            part = parts_of(batch, single, device)[0]
            if repeat == 0:
                with FlopCounterMode(display=False) as counter:
                    one_window(step, part, clock)
                operations = counter.get_total_flops()
            else:
                one_window(step, part, clock)
            with clock.part("AdamW"):
                optimizer.step()
    cpu, wall = (
        {name: statistics.median(values) for name, values in found.items()} for found in (clock.cpu, clock.wall)
    )
    factor = {name: 1 if name == "AdamW" else settings.batch for name in wall}
    limit = matmul_limit(device)
    busy = wall["network forward"] + wall[BACK]
    return {
        "batch": settings.batch,
        "frames": settings.window.frames,
        "size": list(part[0].shape[-2:]),
        "threads": torch.get_num_threads(),
        "device": str(device),
        "processor": platform.processor() or platform.machine(),
        "load_before": round(os.getloadavg()[0], 2),
        "seconds_cpu": {name: round(factor[name] * value, 4) for name, value in cpu.items()},
        "seconds_wall": {name: round(factor[name] * value, 4) for name, value in wall.items()},
        "step_cpu": round(sum(factor[name] * value for name, value in cpu.items()), 3),
        "step_wall": round(sum(factor[name] * value for name, value in wall.items()), 3),
        "network_gflop_a_window": round(operations / 1e9, 3),
        "network_gflops": round(operations / busy / 1e9, 2),
        "matmul_limit_gflops": round(limit / 1e9, 2),
        "network_share_of_limit": round(operations / busy / limit, 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", type=Path)
    parser.add_argument("overrides", nargs="*", help="name=value")
    parser.add_argument("--repeats", type=int, default=5)
    chosen = parser.parse_args()
    print(json.dumps(measure(load_consistency_settings(chosen.settings, chosen.overrides), chosen.repeats)))


if __name__ == "__main__":
    main()

"""How fast one core renders clips, scene building included: python benchmarks/synthetic.py.

Rates are per second of processor time of this one thread, so that other loads on the machine count
less; the wall clock's rate stands beside them.
"""

import argparse
import json
import platform
import time
from statistics import median
from typing import get_args

from bathyscope_train.data.synthetic import DOMAINS, Domain, render_clip
from bathyscope_train.data.synthetic.domain import Family


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", choices=sorted(DOMAINS), default="source")
    parser.add_argument("--clips", type=int, default=6, help="clips of each family")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--height", type=int, default=128)
    parser.add_argument("--width", type=int, default=160)
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

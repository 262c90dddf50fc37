"""Score true and wrong depth with every reading of the consistency losses, and print a Markdown table.

Clips are rendered: `even` has light from everywhere, matt textured surfaces and no noise; `source` is the domain that
training starts from, with a light that moves with the camera, highlights and noise. Cameras are the true ones.
Gaussians are one a pixel, small and nearly opaque, in the colour of the pixel at the depth that is scored. Numbers are
means over clips: of the loss in the row of the truth, below it of the loss divided by that of the true depth.

    python benchmarks/consistency_losses.py [--clips 4]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/support"))

from wrong_depths import TrueClip, evenly_lit, painted, shrunk, true_clip, wrong_depths

from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.losses.photometric import photometric_loss
from bathyscope_train.losses.temporal import moving_edges_loss, temporal_gradient_loss
from bathyscope_train.losses.valid import photometric_pixels
from bathyscope_train.losses.world import meeting_pixels, world_consistency_loss
from bathyscope_train.render import CpuRenderer, leave_one_out

STRIDE = 3
FRAMES = 7


def readings(truth: TrueClip) -> dict[str, Callable[[TrueClip], float]]:
    """Every loss as a function of a clip; valid sets are those of the truth."""
    renderer = CpuRenderer()
    counts = photometric_pixels(truth.frames, truth.valid.all(1))
    meets = meeting_pixels(*truth.geometry, stride=STRIDE)

    def rgb(clip: TrueClip, *, all_views: bool, divided: bool) -> float:
        scene, cameras = painted(clip), (clip.world_from_camera, clip.intrinsics, clip.size)
        view = renderer(scene, *cameras) if all_views else leave_one_out(renderer, scene, *cameras)
        opacity = view.opacity if divided else None
        return float(photometric_loss(view.image, clip.frames, counts, opacity=opacity, reduction="mean"))

    def world(clip: TrueClip, **options: object) -> float:
        return float(world_consistency_loss(*clip.geometry, stride=STRIDE, reduction="mean", **options))  # type: ignore[arg-type]

    return {
        "rgb, all views": lambda clip: rgb(clip, all_views=True, divided=False),
        "rgb, left out": lambda clip: rgb(clip, all_views=False, divided=False),
        "rgb, left out, / opacity": lambda clip: rgb(clip, all_views=False, divided=True),
        "3D, as written": lambda clip: world(clip, scale_free=False, delta=1.0),
        "3D, scale-free": world,
        "3D, fixed set": lambda clip: world(clip, meets=meets),
        "temp, as written": lambda clip: float(temporal_gradient_loss(clip.depth, clip.valid, stride=STRIDE)),
        "temp, moving edges": lambda clip: float(moving_edges_loss(*clip.geometry, stride=STRIDE)),
        "temp, fixed set": lambda clip: float(moving_edges_loss(*clip.geometry, stride=STRIDE, meets=meets)),
    }


def score(clip: TrueClip) -> dict[str, list[float]]:
    """Row by row: losses of the truth, then ratios to them."""
    losses = readings(clip)
    truth = [loss(clip) for loss in losses.values()]
    rows = {"truth": truth}
    for name, wrong in (wrong_depths(clip) | {"scene and poses x 0.5": shrunk(clip, 0.5)}).items():
        found = [loss(wrong) for loss in losses.values()]
        rows[name] = [value / true for value, true in zip(found, truth, strict=True)]
    return rows


def table(clips: list[TrueClip]) -> str:
    """Means over clips."""
    scored = [score(clip) for clip in clips]
    lines = ["| depth | " + " | ".join(readings(clips[0])) + " |", "| --- " * (1 + len(readings(clips[0]))) + "|"]
    for name in scored[0]:
        columns = zip(*(rows[name] for rows in scored), strict=True)
        means = [sum(values) / len(clips) for values in columns]
        cells = [f"{mean:.2g}" if name == "truth" else f"{mean:.2f}" for mean in means]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=4, help="clips of each kind")
    count = parser.parse_args().clips
    torch.manual_seed(0)
    even = [true_clip(seed, evenly_lit("cavity"), frames=FRAMES) for seed in range(1, count + 1)]
    print(f"even light, {count} clips\n\n{table(even)}\n")
    source = [true_clip(seed, DOMAINS["source"], frames=FRAMES) for seed in range(1, count + 1)]
    print(f"domain source, {count} clips\n\n{table(source)}")


if __name__ == "__main__":
    main()

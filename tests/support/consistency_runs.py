"""Miniature runs of the consistency optimisation: a small network, videos that pan over a wall, a few steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from bathyscope_train.consistency.settings import ConsistencySettings, parse_consistency_settings
from bathyscope_train.model import Network
from bathyscope_train.model.checkpoints import save_checkpoint
from bathyscope_train.model.presets import get_preset

SIZE = (28, 42)
FRAMES = 4


def uneven_network(seed: int = 0) -> Network:
    """A fresh ``tiny`` whose depth varies: a fresh one says nearly the same everywhere."""
    torch.manual_seed(seed)
    network = Network(get_preset("tiny")).eval()
    with torch.no_grad():
        for value in network.depth_head.parameters():
            value.add_(0.05 * torch.randn_like(value))
    return network


def write_init(path: Path) -> Path:
    save_checkpoint(uneven_network(), path)
    return path


def write_videos(root: Path, count: int = 2, frames: int = 8) -> Path:
    """Folders of frames that pan over a textured wall, 3 columns a frame."""
    for number in range(count):
        noise = np.random.default_rng(number).uniform(60, 220, (14, 60, 3)).astype(np.float32)
        wall = cv2.resize(noise, (240, 56), interpolation=cv2.INTER_CUBIC).clip(40, 255).astype(np.uint8)
        folder = root / f"pan{number}"
        folder.mkdir(parents=True)
        for frame in range(frames):
            cv2.imwrite(str(folder / f"{frame:03d}.png"), wall[:, 3 * frame : 3 * frame + 84])
    return root


def run_values(data: Path, init: Path, out: Path, **changes: Any) -> dict[str, Any]:
    """Settings of a run of a few steps, as a mapping."""
    return {
        "task": "consistency",
        "data": str(data),
        "init": str(init),
        "out": str(out),
        "cache": str(data.parent / "survey"),
        "steps": 4,
        "warmup_steps": 2,
        "window": {"frames": FRAMES, "size": list(SIZE), "motion_jitter": 1},
        "loss": {
            "image": {"views": "others", "divide_by_opacity": True},
            "world": {"stride": 2},
            "temporal": {"stride": 2, "scales": 2},
            "anchor": {"weight": 0.05},
        },
        "checkpoint_every": 2,
        "validate_every": 0,
        "pictures_every": 100,
        "log_every": 1,
        "loaders": 0,
        "threads": 1,
        "device": "cpu",
        "precision": "float32",
        "tensorboard": False,
    } | changes


def run_settings(data: Path, init: Path, out: Path, **changes: Any) -> ConsistencySettings:
    return parse_consistency_settings(run_values(data, init, out, **changes), "test")


def totals(out: Path) -> dict[int, float]:
    """Loss of every step that ``metrics.jsonl`` tells."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["total"] for line in lines if "total" in line}

"""Accumulated and expected depth of a scene with holes, against its true depth: one line of JSON for each share.

A wavy wall at about 75 mm, seen by a pinhole camera of 224x280 pixels, is covered with opaque Gaussians, one for each
pixel, whose depth is wrong by a smooth log-normal error of ``--sigma``. Disks of ``--radius`` pixels are then cut out
until the share of Gaussians is gone. Both depths are rendered, scaled by medians and clipped to 0.001 to 150 mm, holes
included, as published evaluators do; expected depth in a hole is that of the Gaussians that still reach into it.

    python benchmarks/scene_with_holes.py [--sigma 0.12] [--opacity 0.9] [--radius 2]
"""

from __future__ import annotations

import argparse
import json

import cv2
import numpy as np

from bathyscope.gaussians import Gaussians
from bathyscope.splat import render
from bathyscope_train.evaluation.metrics import depth_errors

SIZE, FOCAL = (224, 280), 224.0
INTRINSICS = np.array([[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1]])
SHARES = (0.0, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1)
LOW, HIGH = 1e-3, 150.0


def wall() -> np.ndarray:
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    return 75 + 18 * np.sin(u / 40) * np.cos(v / 35) + 6 * np.sin(u / 11)


def smooth_noise(rng: np.random.Generator) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.standard_normal(SIZE), (0, 0), 12)
    return np.asarray(noise / noise.std())


def holes(share: float, radius: int, rng: np.random.Generator) -> np.ndarray:
    """(h, w) where Gaussians are cut out."""
    gone = np.zeros(SIZE, np.uint8)
    while gone.mean() < share:
        row, column = (int(rng.integers(0, side)) for side in SIZE)
        cv2.circle(gone, (column, row), radius, 1, -1)
    return gone.astype(bool)


def scene(depth: np.ndarray, keep: np.ndarray, opacity: float) -> Gaussians:
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] + 0.5
    rays = np.stack([(u - SIZE[1] / 2) / FOCAL, (v - SIZE[0] / 2) / FOCAL, np.ones(SIZE)], -1)
    means = (rays * depth[..., None])[keep].astype(np.float32)
    count = len(means)
    rotations = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    scales = (0.7 * means[:, 2:] / FOCAL).repeat(3, axis=1)
    return Gaussians(means, rotations, scales, np.full(count, opacity, np.float32), np.zeros((count, 1, 3), np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sigma", type=float, default=0.12)
    parser.add_argument("--opacity", type=float, default=0.9)
    parser.add_argument("--radius", type=int, default=2, help="of the disks, in pixels")
    given = parser.parse_args()
    true = wall()
    wrong = true * np.exp(given.sigma * smooth_noise(np.random.default_rng(0)))
    for share in SHARES:
        gone = holes(share, given.radius, np.random.default_rng(1))
        picture = render(scene(wrong, ~gone, given.opacity), np.eye(4), INTRINSICS, SIZE, colour=False)
        line: dict[str, object] = {"cut_out": round(float(gone.mean()), 4)}
        line["opacity_below_half"] = round(float((picture.opacity < 0.5).mean()), 4)
        for name, depth in (("accumulated", picture.accumulated), ("expected", picture.depth)):
            aligned = np.clip(depth * np.median(true) / np.median(depth), LOW, HIGH)
            found = depth_errors(true.ravel(), aligned.ravel().astype(np.float64)).as_dict()
            line[name] = {key: round(found[key], 3) for key in ("abs_rel", "sq_rel", "rmse", "rmse_log", "delta1")}
        print(json.dumps(line))


if __name__ == "__main__":
    main()

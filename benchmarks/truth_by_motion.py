"""Whether the truth of a data set agrees with its own video, as far as points can be followed in it.

    python benchmarks/truth_by_motion.py colon_phantom_a colon_phantom_b colon_rendered_a

No network is asked: points are compared with where true depth and true poses take them. By depth (nearest tenth, the
next two, the rest): how far true motion goes, how far from there the points are (medians, pixels), and how much of it
they make (1: all). Then what makes truth and video agree best, by robust least squares (mean log(1 + miss^2)): a
constant added to depth, another focal length, radial distortion, or longer or shorter ways of the camera.
"""

import argparse
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from bathyscope.camera import F64, invert_pose
from bathyscope.vision.field_of_view import FieldOfView
from bathyscope.vision.grid import Grid
from bathyscope_serve.engine_settings import TrackSettings
from bathyscope_serve.refine.tracks import PointTracker
from bathyscope_train.evaluation.calibration import Calibration
from bathyscope_train.evaluation.folders import DatasetFolder

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
PLAIN = np.array([0.0, 1.0, 0.0, 1.0])
"""Offset in median depths, focal length, radial distortion, length of the way."""
MODELS = {"as it is": [], "offset": [0], "focal length": [1], "radial distortion": [2], "length of the way": [3]}


@dataclass(frozen=True)
class Motions:
    """n points from one frame to the next."""

    before: F64
    """(n, 2) pixels"""
    after: F64
    """(n, 2) pixels"""
    depth: F64
    """(n,) true, in the frame before."""
    motion: F64
    """(n, 4, 4) true, from the camera before to the next."""

    def carried(self, calibration: Calibration, model: F64) -> tuple[F64, F64]:
        """Where truth takes the points, and where they were found: (n, 2) each, pixels without distortion."""
        offset, focal, radial, way = model
        f, centre = focal * calibration.fx, np.array([calibration.cx, calibration.cy])

        def ray(places: F64) -> F64:
            plain = (places - centre) / f
            return np.asarray(plain * (1 + radial * (plain**2).sum(1, keepdims=True)), np.float64)

        z = self.depth + offset * np.median(self.depth)
        points = np.concatenate([ray(self.before) * z[:, None], z[:, None]], 1)
        moved = np.einsum("nij,nj->ni", self.motion[:, :3, :3], points) + way * self.motion[:, :3, 3]
        return f * moved[:, :2] / moved[:, 2:], f * ray(self.after)


def follow(data: DatasetFolder) -> Motions:
    """All points of all pairs of neighbouring frames that have depth."""
    height, width = data.calibration.size
    grid = Grid.of(FieldOfView(np.ones((height, width), np.bool_), "full"), (height, width))
    tracker = PointTracker(grid, TrackSettings())
    poses = data.world_from_camera.copy()
    poses[:, :3, 3] *= _pose_unit_in_depths(data.calibration)
    ids, places, depth = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((height, width))
    found = []
    for index in range(len(data.frames)):
        sight = tracker.sight(data.image(index))
        _, a, b = np.intersect1d(ids, sight.ids, return_indices=True)
        if index and len(a):
            z = depth[places[a, 1].astype(int), places[a, 0].astype(int)]
            motion = np.broadcast_to(invert_pose(poses[index]) @ poses[index - 1], (len(a), 4, 4))
            known = (z > 0) & np.isfinite(motion).all((1, 2))
            found.append((places[a][known], sight.places[b][known].astype(np.float64), z[known], motion[known]))
        true = data.truth.at(index)
        ids, places, depth = sight.ids, sight.places.astype(np.float64), np.zeros((height, width))
        depth[true.rows, true.columns] = true.depth
    return Motions(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _pose_unit_in_depths(calibration: Calibration) -> float:
    if calibration.pose_unit == calibration.depth_unit:
        return 1.0
    return METRES[str(calibration.pose_unit)] / METRES[str(calibration.depth_unit)]


def by_depth(motions: Motions, calibration: Calibration) -> list[dict[str, float]]:
    """The table's rows, nearest first."""
    there, seen = motions.carried(calibration, PLAIN)
    begin = motions.before - (calibration.cx, calibration.cy)
    way, made = there - begin, seen - begin
    share = (way * made).sum(1) / np.maximum((way**2).sum(1), 1e-9)
    edges = np.quantile(motions.depth, [0, 0.1, 0.3, 1])
    rows = []
    for low, high in pairwise(edges):
        inside = (motions.depth >= low) & (motions.depth <= high)
        values = np.linalg.norm(way, axis=1), np.linalg.norm(there - seen, axis=1), share
        far, miss, part = (round(float(np.median(each[inside])), 2) for each in values)
        rows.append(
            {"from": round(float(low), 2), "to": round(float(high), 2), "px": far, "miss_px": miss, "share": part}
        )
    return rows


def best(motions: Motions, calibration: Calibration, free: list[int]) -> tuple[F64, float]:
    """The values that make truth and video agree best, and how well they then do."""

    def model(values: F64) -> F64:
        whole = PLAIN.copy()
        whole[free] = values
        return whole

    def cost(values: F64) -> float:
        there, seen = motions.carried(calibration, model(values))
        return float(np.log1p(((there - seen) ** 2).sum(1)).mean())

    values = np.asarray(minimize(cost, PLAIN[free], method="Nelder-Mead").x) if free else np.zeros(0)
    return model(values), cost(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="of data sets, with dense depth and poses")
    for folder in parser.parse_args().folders:
        data = DatasetFolder.open(folder)
        motions = follow(data)
        for row in by_depth(motions, data.calibration):
            print(json.dumps({"data": data.name, **row}))
        for name, free in MODELS.items():
            model, cost = best(motions, data.calibration, free)
            values = [round(float(v), 3) for v in model[free]]
            if name == "offset":
                values = [round(float(model[0] * np.median(motions.depth)), 3)]
            print(json.dumps({"data": data.name, "model": name, "values": values, "cost": round(cost, 4)}), flush=True)


if __name__ == "__main__":
    main()

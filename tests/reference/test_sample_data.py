"""The sample sequences (``BATHYSCOPE_DATA``): our conventions carry their depth from frame to frame."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from bathyscope.camera import project, unproject
from bathyscope_train.evaluation.calibration import Calibration
from bathyscope_train.evaluation.folders import DatasetFolder

DATA = Path(os.environ.get("BATHYSCOPE_DATA", Path(__file__).parents[2] / "../shared/data"))
AGREEMENT = {"colon_phantom_a": 0.02, "colon_phantom_b": 0.03, "colon_rendered_a": 0.03}
"""The data set's own README says 1.2, 1.6 and 1.8 %, the median over the pairs of neighbouring frames."""


def sample(name: str) -> DatasetFolder:
    if not (DATA / name).is_dir():
        pytest.skip(f"no sample data {name} under {DATA}")
    return DatasetFolder.open(DATA / name)


def matrix(camera: Calibration) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def depth_map(folder: DatasetFolder, index: int) -> np.ndarray:
    known = folder.truth.at(index)
    depth = np.zeros(folder.calibration.size)
    depth[known.rows, known.columns] = known.depth
    return depth


def disagreement(folder: DatasetFolder, index: int) -> float:
    """Median relative difference between the depth of a frame carried to the next and the depth there."""
    k = matrix(folder.calibration)
    source, target = depth_map(folder, index), depth_map(folder, index + 1)
    points = unproject(source, k, folder.world_from_camera[index])[source > 0]
    pixels, expected = project(points, k, folder.world_from_camera[index + 1])
    h, w = folder.calibration.size
    inside = (expected > 0) & ((pixels > 0) & (pixels < (w, h))).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    observed, expected = target[rows, columns], expected[inside]
    both = observed > 0
    assert both.sum() > 0.1 * source.size
    return float(np.median(np.abs(observed - expected)[both] / observed[both]))


@pytest.mark.parametrize("name", AGREEMENT)
def test_depth_carried_to_the_next_frame_by_the_poses_is_the_depth_there(name: str) -> None:
    """Over all pairs: single ones differ by up to 14 %, as the data set says itself."""
    folder = sample(name)
    pairs = [disagreement(folder, index) for index in range(len(folder.frames) - 1)]
    assert np.median(pairs) < AGREEMENT[name]


def test_sparse_points_keep_the_observations_that_optical_flow_confirms() -> None:
    folder = sample("sinus")
    with np.load(DATA / "sinus" / "sparse.npz") as arrays:
        error = arrays["obs_flow_err_px"]
    kept = sum(len(folder.truth.at(t).depth) for t in range(len(folder.frames)))
    assert 0.9 * (error < 1).sum() < kept <= (error < 1).sum()
    assert folder.has_pose.all()
    assert (len(folder.frames), folder.truth.kind) == (280, "sparse")


@pytest.mark.parametrize(("name", "low", "high"), [("simcol", 0, 20), ("rgbd_kitchen", 300, 5000)])
def test_dense_depth_is_in_the_stated_unit_and_range(name: str, low: float, high: float) -> None:
    depth = sample(name).truth.at(3).depth
    assert len(depth) > 10_000
    assert low < depth.min()
    assert depth.max() < high

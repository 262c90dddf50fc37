"""EndoDAC's loss functions against published values (``endodac/losses*.npz``)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from bathyscope_train.losses.corner_warping import grid_coordinates, reproject, sample, warp_by_depth
from bathyscope_train.losses.resemblance import masked_average, photometric_error, structural_dissimilarity
from bathyscope_train.losses.smoothness import appearance_smoothness, disparity_smoothness
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.systems.endodac.pose import motion_matrix

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
CASES = sorted((REFERENCE / "endodac").glob("losses*.npz"))
TOLERANCE = 1e-5

pytestmark = pytest.mark.skipif(not CASES, reason=f"no endodac/losses*.npz under {REFERENCE}")
every_case = pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)


def load(path: Path) -> dict[str, Tensor]:
    with np.load(path) as file:
        return {name: torch.from_numpy(file[name]) for name in file.files}


def assert_close(observed: Tensor, expected: Tensor) -> None:
    assert observed.shape == expected.shape
    assert (observed - expected).abs().max() <= TOLERANCE * expected.abs().max()


@every_case
def test_pictures_are_compared_as_published(path: Path) -> None:
    data = load(path)
    assert_close(structural_dissimilarity(data["pred"], data["target"]), data["ssim_map"])
    error = photometric_error(data["pred"], data["target"])
    assert_close(error, data["photometric"])
    assert_close(masked_average(error, data["mask"]), data["masked_photometric"])


@every_case
def test_smoothness_gives_way_at_edges_as_published(path: Path) -> None:
    data = load(path)
    assert_close(disparity_smoothness(data["disp"], data["pred"]), data["smooth_normalised_disp"])
    difference = data["pred"] - data["target"]
    assert_close(appearance_smoothness(data["transform"], difference, data["mask"]), data["smooth_bright"])


@every_case
def test_motions_become_matrices_as_published(path: Path) -> None:
    data = load(path)
    matrix = motion_matrix(data["axisangle"][:, 0], data["translation"][:, 0])
    assert_close(matrix, data["T"])
    assert_close(invert_rigid(matrix), data["T_inv"])


@every_case
def test_a_source_is_warped_by_depth_as_published(path: Path) -> None:
    data = load(path)
    depth, intrinsics = data["depth"][:, 0], data["K"][:, :3, :3]
    pixels, _ = reproject(depth, data["T"], intrinsics)
    size = (depth.shape[-2], depth.shape[-1])
    assert_close(grid_coordinates(pixels, size), data["pix_coords"])
    assert_close(sample(data["target"], pixels), data["warped_target"])
    assert_close(warp_by_depth(data["target"], depth, data["T"], intrinsics), data["warped_target"])

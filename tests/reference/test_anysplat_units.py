"""Single functions of the network against the published implementation (``anysplat/golden_units*/``)."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from bathyscope_train.model.pose_encoding import (
    decode_cameras,
    encode_cameras,
    matrix_to_quaternion,
    quaternion_to_matrix,
)
from bathyscope_train.model.preprocessing import fit, square_crop
from bathyscope_train.model.unprojection import invert_rigid, unproject
from bathyscope_train.model.view_embedding import add_view_embedding, view_coordinates
from bathyscope_train.model.vit import position_embedding

REFERENCE = Path(os.environ.get("BATHYSCOPE_REFERENCE", Path(__file__).parents[2] / "../shared/reference"))
TOLERANCE = 2e-4


def files(name: str) -> pytest.MarkDecorator:
    found = sorted((REFERENCE / "anysplat").glob(f"golden_*/{name}.npz"))
    reason = f"no anysplat/golden_*/{name}.npz under {REFERENCE}"
    missing = [pytest.param(None, marks=pytest.mark.skip(reason=reason))]
    return pytest.mark.parametrize("path", found or missing, ids=lambda path: path.parent.name if path else "missing")


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return dict(arrays)


def assert_same(observed: Tensor, expected: np.ndarray) -> None:
    assert observed.shape == expected.shape
    values = observed.double().numpy()
    same_infinity = np.isinf(expected) & (values == expected)
    values, expected = (np.where(same_infinity, 0, array) for array in (values, expected))
    assert (np.abs(values - expected) / (1 + np.abs(expected))).max() <= TOLERANCE


@files("pose_encoding")
def test_pose_encodings_decode_to_the_published_cameras(path: Path) -> None:
    data = load(path)
    encoding = torch.from_numpy(data["decode_pose_enc"])
    height, width = data["image_size_hw"].tolist()
    anysplat = decode_cameras(encoding, (height, width), focal_epsilon=1e-3)
    assert_same(anysplat.camera_from_world[..., :3, :], data["decode_extrinsics_w2c"])
    assert_same(anysplat.intrinsics, data["decode_intrinsics_anysplat"])
    assert_same(decode_cameras(encoding, (height, width)).intrinsics, data["decode_intrinsics_vggt"])


@files("pose_encoding")
def test_cameras_encode_to_the_published_numbers(path: Path) -> None:
    data = load(path)
    poses = torch.from_numpy(data["encode_extrinsics_w2c"])
    height, width = data["image_size_hw"].tolist()
    pixels, normalised = (torch.from_numpy(data[f"encode_intrinsics_{unit}"]) for unit in ("px", "normalized"))
    assert_same(encode_cameras(poses, pixels, (height, width)), data["encode_pose_enc"])
    assert_same(encode_cameras(poses, normalised, (1, 1)), data["encode_pose_enc_from_normalized"])


@files("pose_encoding")
def test_quaternions_and_matrices_convert_as_published(path: Path) -> None:
    data = load(path)
    assert_same(quaternion_to_matrix(torch.from_numpy(data["quat_xyzw_in"])), data["quat_to_matrix"])
    observed = matrix_to_quaternion(torch.from_numpy(data["matrix_in"]))
    assert_same(observed, data["matrix_to_quat_xyzw"])


@files("unprojection")
def test_unprojection_starts_at_integer_pixels(path: Path) -> None:
    data = load(path)
    depth, poses, intrinsics = (torch.from_numpy(data[k]) for k in ("depth", "extrinsics_w2c", "intrinsics_px"))
    world_from_camera = invert_rigid(poses)
    assert_same(world_from_camera, data["camera_to_world"])
    points = unproject(depth, intrinsics, world_from_camera, pixel_center=0.0)
    assert_same(points, data["world_points"])
    camera = points @ poses[..., None, :3, :3].transpose(-1, -2) + poses[..., None, None, :3, 3]
    pixels = camera @ intrinsics[..., None, :, :].transpose(-1, -2)
    assert_same(pixels[..., :2] / pixels[..., 2:], data["reprojected_uv"])


@files("dpt_pos_embed")
def test_view_embedding_matches(path: Path) -> None:
    data = load(path)
    for name in (key.removesuffix("_embed") for key in data if key.endswith("_embed")):
        match = re.fullmatch(r"C(\d+)_h(\d+)_w(\d+)_H(\d+)_W(\d+)", name)
        assert match, name
        channels, rows, columns, height, width = map(int, match.groups())
        maps = torch.zeros(1, channels, rows, columns)
        observed = add_view_embedding(maps, (height, width))[0].permute(1, 2, 0)
        expected = data[f"{name}_embed"]
        step = 1 if expected.shape[0] == rows else 4
        assert_same(observed[::step, ::step], expected)
        u, v = view_coordinates((rows, columns), (height, width), like=maps)
        grid = torch.stack((u[None, :].expand(rows, columns), v[:, None].expand(rows, columns)), -1)
        assert_same(grid, data[f"{name}_uv"])


@files("dino_pos_embed")
def test_position_embedding_is_resized_as_published(path: Path) -> None:
    data = load(path)
    embedding = torch.from_numpy(data.pop("pos_embed"))
    side = round((embedding.shape[1] - 1) ** 0.5)
    for name, expected in data.items():
        height, width = (int(part[1:]) for part in name.split("_"))
        class_part, grid = position_embedding(embedding, side, (height // 14, width // 14))
        assert_same(torch.cat((class_part, grid), dim=1), expected)


@files("preprocessing")
def test_images_are_prepared_to_within_one_level(path: Path) -> None:
    data = load(path)
    for name, expected in data.items():
        size, kind = name.rsplit("_", 1)
        if kind == "input":
            continue
        image = data[f"{size}_input"]
        match = re.fullmatch(r"(square|crop|pad)(\d+)", kind)
        assert match, name
        mode, target = match[1], int(match[2])
        if mode == "square":
            observed = square_crop(image, target)
        else:
            observed = fit(image, target, mode="crop" if mode == "crop" else "pad")
        assert observed.shape == expected.shape, name
        assert np.abs(observed.astype(int) - expected).max() <= 1, name

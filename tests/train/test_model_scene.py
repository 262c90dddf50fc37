"""Scenes: cameras and Gaussians agree, in whichever world they are expressed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope.model_spec import SceneSpec
from bathyscope.scene import WindowMaps
from bathyscope.scene import assemble_scene as numpy_scene
from bathyscope.splat import render
from bathyscope_train.model.gaussian_parameters import CONSTANT_HARMONIC, GaussianBatch, map_opacity
from bathyscope_train.model.harmonics import evaluate_harmonics, rotate_harmonics
from bathyscope_train.model.network import DenseMaps, Prediction
from bathyscope_train.model.pose_encoding import decode_cameras, encode_cameras
from bathyscope_train.model.presets import SceneSettings
from bathyscope_train.model.quaternions import multiply, quaternion_from_rotation
from bathyscope_train.model.scene import Scene, assemble_scene
from bathyscope_train.model.unprojection import invert_rigid, unproject
from bathyscope_train.model.voxels import PADDED_POSITION, fuse_batch, fuse_voxels

ANYSPLAT = SceneSettings(pixel_center=0.0, focal_epsilon=1e-3, activation="anysplat")
FUSED = ANYSPLAT.model_copy(update={"voxel_size": 0.05})
FOOTPRINT = SceneSettings()


def random_rotation(seed: int) -> Tensor:
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix()).float()


def random_prediction(seed: int = 0, *, degree: int = 2, size: tuple[int, int] = (10, 14)) -> tuple[Prediction, Tensor]:
    """Three frames of a wavy surface about two units away; the first camera is not the identity."""
    generator = torch.Generator().manual_seed(seed)
    frames, height, width = 3, *size
    turns = Rotation.from_euler("xyz", 0.2 * torch.randn(frames, 3, generator=generator).double().numpy())
    poses = torch.eye(4).repeat(frames, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turns.as_matrix()).float()
    poses[:, :3, 3] = 0.2 * torch.randn(frames, 3, generator=generator)
    intrinsics = torch.tensor([[12.0, 0, width / 2], [0, 11.0, height / 2], [0, 0, 1]]).repeat(frames, 1, 1)
    encoding = encode_cameras(poses, intrinsics, size)
    depth = 2 + 0.3 * torch.rand(1, frames, height, width, generator=generator)
    raw = torch.randn(1, frames, 9 + 3 * (degree + 1) ** 2, height, width, generator=generator)
    maps = DenseMaps(depth, torch.ones_like(depth), raw)
    return Prediction(encoding[None, None], maps), torch.rand(1, frames, 3, height, width, generator=generator)


def rendered(scene: Scene, frame: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    camera_from_world = invert_rigid(scene.world_from_camera)[0, frame].double().numpy()
    result = render(
        scene.numpy(), camera_from_world, scene.intrinsics[0, frame].double().numpy(), size, backend="numpy"
    )
    assert result.image is not None
    return result.image, result.depth, result.opacity


@pytest.mark.parametrize("settings", [ANYSPLAT, FUSED, FOOTPRINT], ids=["anysplat", "fused", "footprint"])
@pytest.mark.parametrize("degree", [0, 2, 4])
def test_rebasing_changes_no_rendering(settings: SceneSettings, degree: int) -> None:
    prediction, images = random_prediction(degree=degree)
    if settings.activation == "anysplat":  # its Gaussians are sub-pixel specks at this size: make them visible
        assert prediction.maps.gaussians is not None
        prediction.maps.gaussians[:, :, 1:4] += 90
    own, rebased = (assemble_scene(prediction, images, settings, rebase=flag) for flag in (False, True))
    torch.testing.assert_close(rebased.world_from_camera[:, 0], torch.eye(4)[None], rtol=0, atol=0)
    assert not torch.allclose(own.world_from_camera[:, 0], torch.eye(4)[None], atol=1e-2)
    for frame in range(3):
        for expected, observed in zip(rendered(own, frame, (10, 14)), rendered(rebased, frame, (10, 14)), strict=True):
            # A Gaussian at the 1/255 cut-off may fall to either side of it.
            close = np.isclose(observed, expected, atol=2e-4)
            assert close.mean() > 0.99
            assert np.abs(observed - expected).max() < 2e-2


@pytest.mark.parametrize("settings", [ANYSPLAT, FUSED, FOOTPRINT], ids=["anysplat", "fused", "footprint"])
def test_the_service_assembles_the_same_scene_in_numpy(settings: SceneSettings) -> None:
    prediction, images = random_prediction(degree=2)
    assert prediction.maps.gaussians is not None
    expected = assemble_scene(prediction, images, settings)
    values = (prediction.maps.depth, prediction.maps.confidence, prediction.maps.gaussians, prediction.pose_encoding)
    spec = SceneSpec(
        pixel_centre=0.5 if settings.pixel_center else 0.0,
        focal_epsilon=settings.focal_epsilon,
        activation=settings.activation,
        sh_degree=2,
        voxel_size=settings.voxel_size,
    )
    observed = numpy_scene(WindowMaps(*(value[0].numpy() for value in values)), images[0].numpy(), spec)
    np.testing.assert_allclose(observed.cameras.world_from_camera, expected.world_from_camera[0], atol=1e-5)
    np.testing.assert_allclose(observed.cameras.intrinsics, expected.intrinsics[0], rtol=1e-5)
    wanted = expected.numpy()
    np.testing.assert_allclose(observed.gaussians.means, wanted.means, atol=1e-4)
    np.testing.assert_allclose(observed.gaussians.scales, wanted.scales, rtol=1e-4)
    np.testing.assert_allclose(observed.gaussians.opacities, wanted.opacities, atol=1e-5)
    np.testing.assert_allclose(observed.gaussians.harmonics, wanted.harmonics, atol=1e-3)
    alignment = np.abs((observed.gaussians.rotations * wanted.rotations).sum(1))
    np.testing.assert_allclose(alignment, 1, atol=1e-3)


def test_rebasing_keeps_relative_poses() -> None:
    prediction, images = random_prediction()
    own, rebased = (
        assemble_scene(prediction, images, FOOTPRINT, rebase=flag).world_from_camera for flag in (False, True)
    )
    relative = invert_rigid(own[:, :1]) @ own
    torch.testing.assert_close(rebased, relative, rtol=0, atol=1e-5)


def test_footprint_gaussians_of_a_silent_head_are_round_pixels_in_their_own_colour() -> None:
    prediction, images = random_prediction(degree=0)
    assert prediction.maps.gaussians is not None
    prediction.maps.gaussians.zero_()
    gaussians = assemble_scene(prediction, images, FOOTPRINT).gaussians
    depth = prediction.maps.depth.flatten(1)
    pixel = depth * (1 / 12 + 1 / 11) / 2
    torch.testing.assert_close(gaussians.scales, (math.log(2) * pixel)[..., None].expand(-1, -1, 3))
    torch.testing.assert_close(gaussians.opacities, torch.full_like(depth, 0.5))
    colours = gaussians.harmonics[..., 0, :] * CONSTANT_HARMONIC + 0.5
    torch.testing.assert_close(colours, images.permute(0, 1, 3, 4, 2).flatten(1, 3))


def test_footprint_rotation_is_predicted_in_the_camera_and_turned_into_the_world() -> None:
    prediction, images = random_prediction(degree=0)
    assert prediction.maps.gaussians is not None
    prediction.maps.gaussians[:, :, 4:8] = 0
    scene = assemble_scene(prediction, images, FOOTPRINT)
    pixels = prediction.maps.depth[0, 0].numel()
    for frame in range(3):
        expected = Rotation.from_matrix(scene.world_from_camera[0, frame, :3, :3].numpy())
        own = scene.gaussians.rotations[0, frame * pixels].roll(-1).numpy()
        assert (expected.inv() * Rotation.from_quat(own)).magnitude() < 1e-3


def test_centres_are_the_unprojected_pixels_of_their_frame() -> None:
    prediction, images = random_prediction()
    scene = assemble_scene(prediction, images, FOOTPRINT)
    means = scene.gaussians.means.unflatten(1, (3, 10, 14))
    camera = (means - scene.world_from_camera[:, :, None, None, :3, 3]) @ scene.world_from_camera[:, :, None, :3, :3]
    torch.testing.assert_close(camera[..., 2], prediction.maps.depth)
    projected = camera @ scene.intrinsics[:, :, None].transpose(-1, -2)
    pixels = projected[..., :2] / projected[..., 2:]
    torch.testing.assert_close(pixels[0, 1, 3, 5], torch.tensor([5.5, 3.5]))


def test_a_network_without_gaussians_has_no_scene() -> None:
    prediction, images = random_prediction()
    maps = DenseMaps(prediction.maps.depth, prediction.maps.confidence, None)
    with pytest.raises(GeometryError, match="no Gaussian head"):
        assemble_scene(replace(prediction, maps=maps), images, FOOTPRINT)


@given(seed=st.integers(0, 10_000), degree=st.integers(0, 4))
@settings(max_examples=25, deadline=None)
def test_turned_harmonics_look_from_a_turned_direction_as_before(seed: int, degree: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    coefficients = torch.randn(5, (degree + 1) ** 2, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=generator), dim=-1)
    rotation = random_rotation(seed)
    before = (evaluate_harmonics(directions, degree)[..., None] * coefficients).sum(1)
    turned = rotate_harmonics(coefficients, rotation)
    after = (evaluate_harmonics(directions @ rotation.T, degree)[..., None] * turned).sum(1)
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)


def test_harmonics_are_orthonormal_over_the_sphere() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(12)
    angles = np.arange(24) * 2 * np.pi / 24
    z, phi = (torch.from_numpy(grid.ravel()) for grid in np.meshgrid(nodes, angles, indexing="ij"))
    radius = (1 - z * z).sqrt()
    values = evaluate_harmonics(torch.stack((radius * phi.cos(), radius * phi.sin(), z), -1), 4)
    area = torch.from_numpy(np.repeat(weights, 24) * 2 * np.pi / 24)
    torch.testing.assert_close(
        values.T @ (area[:, None] * values), torch.eye(25, dtype=torch.float64), atol=1e-9, rtol=0
    )


@given(first=st.integers(0, 10_000), second=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_quaternions_multiply_like_their_rotations(first: int, second: int) -> None:
    left, right = random_rotation(first), random_rotation(second)
    product = multiply(quaternion_from_rotation(left), quaternion_from_rotation(right))
    expected = quaternion_from_rotation(left @ right)
    torch.testing.assert_close(product * torch.sign(product @ expected), expected, atol=1e-5, rtol=0)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_encoding_undoes_decoding_without_the_focal_epsilon(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    encoding = torch.randn(4, 9, generator=generator)
    encoding[:, 3:7] = torch.nn.functional.normalize(encoding[:, 3:7], dim=-1)
    encoding[:, 3:7] *= torch.where(encoding[:, 6:7] < 0, -1.0, 1.0)
    encoding[:, 7:] = 0.3 + 2 * torch.rand(4, 2, generator=generator)
    cameras = decode_cameras(encoding, (70, 98))
    again = encode_cameras(cameras.camera_from_world, cameras.intrinsics, (70, 98))
    torch.testing.assert_close(again, encoding, atol=2e-5, rtol=1e-5)


def test_unprojected_plane_has_its_depth_and_spacing() -> None:
    intrinsics = torch.tensor([[2.0, 0, 2], [0, 4.0, 1], [0, 0, 1]])
    points = unproject(torch.full((2, 4), 8.0), intrinsics, torch.eye(4))
    torch.testing.assert_close(points[0, 0], torch.tensor([-6.0, -1.0, 8.0]))
    torch.testing.assert_close(points[1, 3], torch.tensor([6.0, 1.0, 8.0]))


def test_a_voxel_averages_its_points_by_confidence() -> None:
    points = torch.tensor([[0.1, 0.0, 0.0], [-0.2, 0.0, 0.0], [3.0, 0.0, -1.0]])
    features = torch.tensor([[1.0], [4.0], [9.0]])
    fused = fuse_voxels(points, features, torch.tensor([math.log(3.0), 0.0, 5.0]), voxel_size=1.0)
    assert fused.index.tolist() == [[0, 0, 0], [3, 0, -1]]
    assert fused.counts.tolist() == [2, 1]
    torch.testing.assert_close(fused.features, torch.tensor([[1.75], [9.0]]), rtol=1e-5, atol=0)
    torch.testing.assert_close(fused.points, torch.tensor([[0.025, 0, 0], [3, 0, -1]]), rtol=1e-4, atol=1e-6)


def test_shorter_scenes_of_a_batch_are_filled_with_what_cannot_be_seen() -> None:
    points = torch.tensor([[[0.0, 0, 0], [5.0, 0, 0]], [[1.0, 1, 1], [1.0, 1, 1]]])
    fused, features = fuse_batch(points, torch.ones(2, 2, 11), torch.zeros(2, 2), voxel_size=1.0)
    assert fused.shape == (2, 2, 3)
    assert fused[1, 1].tolist() == [PADDED_POSITION] * 3
    assert features[1, 1, 0].sigmoid() == 0


@pytest.mark.parametrize(("probability", "exponent", "expected"), [(0.3, 0.0, 0.3), (0.25, 1.0, 0.46875)])
def test_opacity_mapping_follows_its_formula(probability: float, exponent: float, expected: float) -> None:
    assert map_opacity(torch.tensor(probability), exponent).item() == pytest.approx(expected, abs=1e-6)


def test_moving_gaussians_there_and_back_changes_nothing() -> None:
    prediction, images = random_prediction()
    gaussians = assemble_scene(prediction, images, FOOTPRINT).gaussians
    motion = torch.eye(4)[None].clone()
    motion[:, :3, :3], motion[:, :3, 3] = random_rotation(5), torch.tensor([1.0, -2, 3])
    again: GaussianBatch = gaussians.moved(motion).moved(invert_rigid(motion))
    torch.testing.assert_close(again.means, gaussians.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(again.harmonics, gaussians.harmonics, atol=1e-4, rtol=0)
    alignment = (again.rotations * gaussians.rotations).sum(-1).abs()
    torch.testing.assert_close(alignment, torch.ones_like(alignment), atol=1e-4, rtol=0)

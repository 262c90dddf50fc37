"""Numpy scene assembly: closed forms, and agreement with the network's own (torch) assembly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bathyscope.camera import invert_pose, quaternion_to_matrix, unproject
from bathyscope.errors import GeometryError
from bathyscope.gaussian_parameters import fuse_voxels, map_opacity, rotate_harmonics
from bathyscope.gaussians import Gaussians
from bathyscope.model_spec import SceneSpec
from bathyscope.scene import WindowMaps, assemble_scene, decode_cameras
from bathyscope.splat import render

SIZE = (6, 8)
FOOTPRINT = SceneSpec(pixel_centre=0.5, focal_epsilon=0.0, activation="footprint", sh_degree=0)
ANYSPLAT = SceneSpec(
    pixel_centre=0.0,
    focal_epsilon=1e-3,
    activation="anysplat",
    sh_degree=2,
    voxel_size=0.05,
    opacity_exponent=1.0,
)


def random_maps(frames: int = 3, degree: int = 0, seed: int = 0) -> tuple[WindowMaps, np.ndarray]:
    rng = np.random.default_rng(seed)
    encoding = rng.normal(size=(frames, 9)) * 0.2
    encoding[:, 6] += 1.0
    encoding[:, 7:] = rng.uniform(0.7, 1.4, (frames, 2))
    channels = 9 + 3 * (degree + 1) ** 2
    maps = WindowMaps(
        depth=rng.uniform(0.5, 3, (frames, *SIZE)).astype(np.float32),
        confidence=np.ones((frames, *SIZE), np.float32),
        gaussians=rng.normal(size=(frames, channels, *SIZE)).astype(np.float32),
        pose_encoding=encoding.astype(np.float32),
    )
    return maps, rng.uniform(size=(frames, 3, *SIZE)).astype(np.float32)


def test_cameras_of_an_encoding_follow_the_published_formula() -> None:
    half = np.sqrt(0.5)
    encoding = np.array([[1, 2, 3, 0, 0, 2 * half, 2 * half, np.pi / 2, 2 * np.arctan(0.5)]], np.float32)
    cameras = decode_cameras(encoding, (100, 200), focal_epsilon=0.25)
    quarter_turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(cameras.world_from_camera[0, :3, :3], quarter_turn.T, atol=1e-6)
    np.testing.assert_allclose(cameras.world_from_camera[0, :3, 3], -quarter_turn.T @ [1, 2, 3], atol=1e-6)
    k = cameras.intrinsics[0]
    np.testing.assert_allclose([k[1, 1], k[0, 0]], [50 / 1.25, 100 / 0.75], rtol=1e-6)
    np.testing.assert_allclose(k[:2, 2], [100, 50])


@pytest.mark.parametrize("column", [7, 8])
@pytest.mark.parametrize("value", [-0.1, 3.2], ids=["negative", "over_180_degrees"])
def test_an_impossible_field_of_view_is_refused(column: int, value: float) -> None:
    encoding = np.array([[0, 0, 0, 0, 0, 0, 1, 1, 1]], np.float32)
    encoding[0, column] = value
    with pytest.raises(GeometryError, match="fields of view"):
        decode_cameras(encoding, SIZE, 0.0)


@pytest.mark.parametrize("name", ["depth", "confidence", "gaussians", "pose_encoding"])
def test_values_that_are_not_finite_never_become_a_scene(name: str) -> None:
    maps, _ = random_maps()
    arrays = {key: getattr(maps, key).copy() for key in ("depth", "confidence", "gaussians", "pose_encoding")}
    arrays[name].reshape(-1)[3] = np.nan
    with pytest.raises(GeometryError, match=name):
        WindowMaps(**arrays)


def test_means_lie_where_each_camera_sees_its_pixels() -> None:
    maps, images = random_maps()
    scene = assemble_scene(maps, images, FOOTPRINT)
    np.testing.assert_array_equal(scene.cameras.world_from_camera[0], np.eye(4))
    means = scene.gaussians.means.reshape(3, *SIZE, 3)
    for t in range(3):
        expected = unproject(maps.depth[t], scene.cameras.intrinsics[t], scene.cameras.world_from_camera[t])
        np.testing.assert_allclose(means[t], expected, atol=2e-6)


def test_a_raw_zero_is_a_round_gaussian_of_its_pixel() -> None:
    maps, images = random_maps()
    maps = WindowMaps(maps.depth, maps.confidence, np.zeros_like(maps.gaussians), maps.pose_encoding)
    scene = assemble_scene(maps, images, FOOTPRINT)
    k = scene.cameras.intrinsics
    footprint = maps.depth * ((1 / k[:, 0, 0] + 1 / k[:, 1, 1]) / 2)[:, None, None]
    np.testing.assert_allclose(scene.gaussians.scales[:, 0], np.log(2) * footprint.reshape(-1), rtol=1e-5)
    np.testing.assert_allclose(scene.gaussians.opacities, 0.5)
    colour = 0.28209479177387814 * scene.gaussians.harmonics[:, 0] + 0.5
    np.testing.assert_allclose(colour, images.transpose(0, 2, 3, 1).reshape(-1, 3), atol=1e-6)


def test_only_valid_pixels_become_gaussians() -> None:
    maps, images = random_maps()
    valid = np.zeros((3, *SIZE), np.bool_)
    valid[:, 2:5, 3:] = True
    some, everything = (assemble_scene(maps, images, FOOTPRINT, valid=mask) for mask in (valid, None))
    np.testing.assert_array_equal(some.gaussians.means, everything.gaussians.means[valid.reshape(-1)])


def test_the_change_of_world_changes_no_picture() -> None:
    """The first camera sees the same image and depth whether or not the world was moved to it."""
    maps, images = random_maps(degree=2)
    spec = ANYSPLAT.model_copy(update={"voxel_size": None})
    moved = assemble_scene(maps, images, spec)
    own = assemble_scene(maps, images, spec, first_is_identity=False)
    for t in range(3):
        pictures = [
            render(
                Gaussians(s.gaussians.means, s.gaussians.rotations, s.gaussians.scales * 100, s.gaussians.opacities,
                          s.gaussians.harmonics),
                invert_pose(s.cameras.world_from_camera[t]),
                s.cameras.intrinsics[t],
                SIZE,
                backend="numpy",
            )
            for s in (moved, own)
        ]  # fmt: skip
        assert pictures[0].image is not None
        assert pictures[1].image is not None
        assert pictures[1].opacity.max() > 0.5
        np.testing.assert_allclose(pictures[0].image, pictures[1].image, atol=2e-3)
        np.testing.assert_allclose(pictures[0].accumulated, pictures[1].accumulated, atol=2e-3)


def test_turned_harmonics_have_the_old_value_in_the_turned_direction() -> None:
    from bathyscope.splat.harmonics import harmonic_terms

    rng = np.random.default_rng(1)
    harmonics = rng.normal(size=(2, 25, 3)).astype(np.float32)
    rotation = quaternion_to_matrix(rng.normal(size=4))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)

    def value(coefficients: np.ndarray, d: np.ndarray) -> np.ndarray:
        return np.einsum("k,nkc->nc", np.stack(harmonic_terms(d[0], d[1], d[2], 4)), coefficients)

    turned = rotate_harmonics(harmonics, rotation)
    np.testing.assert_allclose(value(turned, rotation @ direction), value(harmonics, direction), atol=1e-5)


def test_fused_gaussians_are_the_softmax_mean_of_their_cell() -> None:
    points = np.array([[0.01, 0, 0], [0.9, 0, 0], [0.02, 0, 0]])
    features = np.array([[1.0], [5.0], [3.0]], np.float32)
    confidence = np.log(np.array([1, 7, 3], np.float32))
    means, fused = fuse_voxels(points, features, confidence, 0.1)
    np.testing.assert_allclose(means[:, 0], [0.25 * 0.01 + 0.75 * 0.02, 0.9], rtol=1e-5)
    np.testing.assert_allclose(fused[:, 0], [2.5, 5], rtol=1e-5)


def test_opacity_mapping_is_the_published_one() -> None:
    p = np.array([0.25], np.float32)
    np.testing.assert_allclose(map_opacity(p, 0.0), p)
    np.testing.assert_allclose(map_opacity(p, 1.0), 0.5 * (1 - 0.75**2 + 0.5), rtol=1e-6)


@pytest.mark.parametrize("spec", [FOOTPRINT, ANYSPLAT], ids=["footprint", "anysplat"])
def test_numpy_and_torch_build_the_same_scene(spec: SceneSpec) -> None:
    torch: Any = pytest.importorskip("torch")
    network: Any = pytest.importorskip("bathyscope_train.model.network")
    from bathyscope_train.model import scene as torch_scene
    from bathyscope_train.model.presets import SceneSettings

    maps, images = random_maps(degree=spec.sh_degree)
    settings = SceneSettings(
        activation=spec.activation,
        pixel_center=spec.pixel_centre,
        focal_epsilon=spec.focal_epsilon,
        voxel_size=spec.voxel_size,
        opacity_exponent=spec.opacity_exponent,
    )
    prediction = network.Prediction(
        torch.from_numpy(maps.pose_encoding)[None, None],
        network.DenseMaps(*(torch.from_numpy(a)[None] for a in (maps.depth, maps.confidence, maps.gaussians))),
    )
    theirs = torch_scene.assemble_scene(prediction, torch.from_numpy(images)[None], settings)
    ours = assemble_scene(maps, images, spec)
    np.testing.assert_allclose(ours.cameras.world_from_camera, theirs.world_from_camera[0].numpy(), atol=1e-5)
    np.testing.assert_allclose(ours.cameras.intrinsics, theirs.intrinsics[0].numpy(), rtol=1e-5)
    expected = theirs.numpy()
    assert len(ours.gaussians) == len(expected)
    for name in ("means", "scales", "opacities", "harmonics"):
        np.testing.assert_allclose(getattr(ours.gaussians, name), getattr(expected, name), atol=2e-5, err_msg=name)
    cosine = np.abs((ours.gaussians.rotations * expected.rotations).sum(1))
    np.testing.assert_allclose(cosine, np.linalg.norm(expected.rotations, axis=1), atol=1e-5)


def test_maps_that_do_not_fit_the_images_are_refused() -> None:
    maps, images = random_maps()
    with pytest.raises(GeometryError, match="do not fit"):
        assemble_scene(maps, images[:, :, 1:], FOOTPRINT)

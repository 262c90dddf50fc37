"""The two splatting backends against each other, and what both promise beyond the formulas."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from bathyscope.errors import GeometryError, SettingsError
from bathyscope.gaussians import Gaussians
from bathyscope.splat import Backend, Rendering, SplatSettings, prepare, project, render

BACKENDS = ("numba", "numpy")
INTRINSICS = np.array([[60.0, 0, 30], [0, 55.0, 22], [0, 0, 1]])
SIZE = (44, 61)
PLANES = ("image", "depth", "accumulated", "opacity")


def random_scene(seed: int, count: int, degree: int = 2, nearest: float = -0.5) -> Gaussians:
    """Gaussians all around the camera: behind it, in its face, large, small, thin, faint, opaque."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-2, -2, nearest], [2, 2, 4], (count, 3))
    scales = np.exp(rng.normal(-3, 1, (count, 3)))
    opacities = rng.uniform(0, 1, count)
    opacities[: count // 20] = 1.0
    opacities[count // 20 : count // 10] = 0.0
    harmonics = 0.4 * rng.standard_normal((count, (degree + 1) ** 2, 3))
    arrays = (means, rng.standard_normal((count, 4)), scales, opacities, harmonics)
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def camera(seed: int) -> np.ndarray:
    angle = 0.2 * np.random.default_rng(seed).standard_normal()
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.1, -0.2, 0.3]
    return pose


def both(
    scene: Gaussians, pose: np.ndarray, size: tuple[int, int] = SIZE, **options: Any
) -> tuple[Rendering, Rendering]:
    fast, plain = (render(scene, pose, INTRINSICS, size, backend=backend, **options) for backend in BACKENDS)
    return fast, plain


def assert_alike(fast: Rendering, plain: Rendering) -> None:
    """Equal to rounding almost everywhere; a few pixels sit on a threshold and may differ by one faint Gaussian."""
    for name in PLANES:
        difference = np.abs(getattr(fast, name) - getattr(plain, name))
        assert np.quantile(difference, 0.99) <= 2e-5, name
        assert difference.max() <= 2e-2, name


@pytest.mark.parametrize("degree", range(5))
def test_backends_agree_on_random_scenes_of_every_degree(degree: int) -> None:
    scene = random_scene(degree, 600, degree)
    assert_alike(*both(scene, camera(degree), background=np.array([0.2, 0.5, 1.0])))


@pytest.mark.parametrize(
    "settings",
    [
        SplatSettings(antialiased=True),
        SplatSettings(near_plane=1e-10, radius_clip=3.0),
        SplatSettings(far_plane=2.0, max_alpha=0.99, eps2d=0.05),
        SplatSettings(alpha_threshold=0.05, transmittance_cutoff=0.02),
        SplatSettings(alpha_threshold=1e-4, transmittance_cutoff=0.0),
        SplatSettings(degree=1),
    ],
    ids=["antialiased", "near-clip", "far-eps", "coarse", "fine", "degree"],
)
def test_backends_agree_with_other_settings(settings: SplatSettings) -> None:
    scene = random_scene(11, 500)
    assert_alike(*both(scene, camera(3), settings=settings))


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (8, 8), (33, 64)])
def test_backends_agree_at_sizes_that_do_not_fill_tiles(size: tuple[int, int]) -> None:
    assert_alike(*both(random_scene(5, 300), camera(1), size))


def test_backends_agree_when_lists_of_tiles_overflow_their_room() -> None:
    """Every Gaussian covers every tile: far more entries than the kernel has room for at a time."""
    scene = random_scene(6, 900, nearest=1.0)
    scene = dataclasses.replace(scene, scales=np.full_like(scene.scales, 2.0), opacities=scene.opacities * 0.02)
    assert_alike(*both(scene, np.eye(4), (160, 200)))


def test_projections_agree() -> None:
    scene, pose = random_scene(8, 700), camera(2)
    fast, plain = (project(scene, pose, INTRINSICS, SIZE, backend=backend) for backend in BACKENDS)
    np.testing.assert_array_equal(fast.visible, plain.visible)
    np.testing.assert_allclose(fast.means, plain.means, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(fast.depths, plain.depths, rtol=1e-4)
    np.testing.assert_allclose(fast.colours, plain.colours, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_is_its_closed_form(backend: Backend) -> None:
    """A round Gaussian on the axis: a round footprint of variance (f s / z)^2 + 0.3 and the DC colour."""
    focal, scale, depth, opacity = 50.0, 0.1, 2.0, 0.7
    scene = Gaussians(
        np.array([[0, 0, depth]], np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), scale, np.float32),
        np.array([opacity], np.float32),
        np.array([[[1.0, 0.0, -1.0]]], np.float32),
    )
    k = np.array([[focal, 0, 16], [0, focal, 12], [0, 0, 1]])
    found = render(scene, np.eye(4), k, (24, 32), backend=backend, background=np.array([0, 0, 1.0]))
    v, u = np.mgrid[0:24, 0:32] + 0.5
    variance = (focal * scale / depth) ** 2 + 0.3
    alpha = opacity * np.exp(-((u - 16) ** 2 + (v - 12) ** 2) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    colour = np.maximum(0.28209479177387814 * np.array([1, 0, -1]) + 0.5, 0)
    np.testing.assert_allclose(found.opacity, alpha, atol=1e-6)
    np.testing.assert_allclose(found.accumulated, alpha * depth, atol=1e-6)
    np.testing.assert_allclose(found.depth, np.where(alpha > 0, depth, 0), atol=1e-5)
    np.testing.assert_allclose(found.image, alpha[..., None] * colour + (1 - alpha[..., None]) * [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_nearer_of_two_gaussians_hides_the_other_by_its_alpha(backend: Backend) -> None:
    scene = Gaussians(
        np.array([[0, 0, 3.0], [0, 0, 1.0]], np.float32),
        np.array([[1, 0, 0, 0]] * 2, np.float32),
        np.full((2, 3), 10.0, np.float32),
        np.array([0.5, 0.8], np.float32),
        np.zeros((2, 1, 3), np.float32),
    )
    found = render(scene, np.eye(4), INTRINSICS, SIZE, backend=backend)
    row, column = 22, 30
    assert found.opacity[row, column] == pytest.approx(0.8 + 0.2 * 0.5, abs=1e-5)
    assert found.accumulated[row, column] == pytest.approx(0.8 * 1 + 0.2 * 0.5 * 3, abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("behind", [False, True], ids=["empty", "behind"])
def test_a_scene_with_nothing_to_see_is_background(backend: Backend, behind: bool) -> None:
    scene = random_scene(1, 20).select(slice(0, 20 if behind else 0))
    scene = dataclasses.replace(scene, means=scene.means - np.float32(10) * behind)
    found = render(scene, np.eye(4), INTRINSICS, SIZE, backend=backend, background=np.array([0.1, 0.2, 0.3]))
    assert found.image is not None
    np.testing.assert_allclose(found.image, np.broadcast_to([0.1, 0.2, 0.3], (*SIZE, 3)), atol=1e-7)
    assert not found.depth.any()
    assert not found.opacity.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_depth_alone_never_reads_harmonics(backend: Backend) -> None:
    scene = random_scene(2, 400)
    blind = dataclasses.replace(scene, harmonics=np.full_like(scene.harmonics, np.nan))
    seen = render(scene, np.eye(4), INTRINSICS, SIZE, backend=backend)
    unseen = render(blind, np.eye(4), INTRINSICS, SIZE, backend=backend, colour=False)
    assert unseen.image is None
    np.testing.assert_array_equal(unseen.depth, seen.depth)
    np.testing.assert_array_equal(unseen.opacity, seen.opacity)


@pytest.mark.parametrize("backend", BACKENDS)
def test_harmonics_that_are_not_finite_are_refused_in_colour(backend: Backend) -> None:
    scene = random_scene(2, 400)
    broken = dataclasses.replace(scene, harmonics=np.full_like(scene.harmonics, np.nan))
    with pytest.raises(GeometryError, match="harmonics of visible Gaussians"):
        render(broken, np.eye(4), INTRINSICS, SIZE, backend=backend)


def test_threads_at_once_render_what_one_renders_alone() -> None:
    scene = prepare(random_scene(3, 4000))
    poses = [camera(seed) for seed in range(12)]
    alone = [render(scene, pose, INTRINSICS, SIZE) for pose in poses]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda pose: render(scene, pose, INTRINSICS, SIZE), poses))
    for one, other in zip(alone, together, strict=True):
        for name in PLANES:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_order_in_the_scene_only_matters_for_ties() -> None:
    scene = random_scene(4, 500)
    shuffled = scene.select(np.random.default_rng(0).permutation(500))
    one, other = (render(s, np.eye(4), INTRINSICS, SIZE) for s in (scene, shuffled))
    np.testing.assert_array_equal(one.depth, other.depth)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["means", "rotations", "scales", "opacities"])
def test_numbers_that_are_not_finite_are_named(backend: Backend, name: str) -> None:
    scene = random_scene(2, 50)
    values = getattr(scene, name).copy()
    values.reshape(50, -1)[7, 0] = np.nan
    with pytest.raises(GeometryError, match=f"{name} of 1 Gaussians are not finite, the first is number 7"):
        prepare(dataclasses.replace(scene, **{name: values}), backend=backend)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("scales", -1, "negative scale"), ("opacities", 1.5, "opacity outside"), ("rotations", 0, "rotation of length 0")],
)
def test_numbers_without_meaning_are_named(name: str, value: float, message: str) -> None:
    scene = random_scene(2, 50)
    values = getattr(scene, name).copy()
    values[9] = value
    with pytest.raises(GeometryError, match=f"1 Gaussians have .*{message}.* number 9"):
        prepare(dataclasses.replace(scene, **{name: values}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_from_world": np.eye(3)}, r"camera_from_world must have shape \(4, 4\)"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, "camera_from_world has values that are not finite"),
        ({"intrinsics": np.diag([-1.0, 1, 1])}, "focal lengths must be positive"),
        ({"intrinsics": np.array([[1.0, 2, 0], [0, 1, 0], [0, 0, 1]])}, "skew"),
        ({"size": (0, 10)}, "an image size needs sides of 1"),
        ({"background": np.zeros(4)}, "a background is 3 finite RGB values"),
        ({"background": np.zeros(3), "colour": False}, "a background needs colour=True"),
        ({"settings": SplatSettings(degree=3)}, "degree 3 were asked for, the scene has degree 2"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"camera_from_world": np.eye(4), "intrinsics": INTRINSICS, "size": SIZE} | changes
    with pytest.raises(GeometryError, match=message):
        render(random_scene(2, 5), backend="numpy", **arguments)


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(SettingsError, match="eps2d=-1"):
        SplatSettings(eps2d=-1)


def test_a_backend_that_does_not_fit_is_refused() -> None:
    scene = random_scene(2, 5)
    with pytest.raises(SettingsError, match="float32, not float64"):
        prepare(scene, settings=SplatSettings(precision="float64"), backend="numba")
    with pytest.raises(SettingsError, match="prepared for the numpy backend"):
        render(prepare(scene, backend="numpy"), np.eye(4), INTRINSICS, SIZE, backend="numba")
    with pytest.raises(SettingsError, match="'numba' and 'numpy', got 'cuda'"):
        prepare(scene, backend="cuda")  # type: ignore[arg-type]

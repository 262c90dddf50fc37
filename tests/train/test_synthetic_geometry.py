"""Rendered depth, poses and intrinsics agree with each other and with the scene, by other means."""

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from bathyscope_train.data.synthetic import DOMAINS, SyntheticClip, render_clip
from bathyscope_train.data.synthetic.kernels import render
from bathyscope_train.data.synthetic.noise import gradient_noise, periodic_noise
from bathyscope_train.data.synthetic.scene import FIELD, TUBE, Scene, Surface, make_surface
from bathyscope_train.data.synthetic.shading import Lamp
from bathyscope_train.data.synthetic.tissue import make_tissue

SIZE = (56, 70)
FAMILIES = ("lumen", "cavity", "sinus", "larynx", "closeup", "indoor")


def clip_of(family: str, seed: int) -> SyntheticClip:
    domain = DOMAINS["source"].model_copy(update={"families": {family: 1.0}})
    return render_clip(seed, domain, frames=5, size=SIZE)


def pixel_centres(size: tuple[int, int]) -> npt.NDArray[np.float64]:
    rows, columns = np.mgrid[: size[0], : size[1]]
    return np.stack([columns + 0.5, rows + 0.5], axis=-1)


def points_of(clip: SyntheticClip, frame: int) -> npt.NDArray[np.float64]:
    focal, centre = clip.intrinsics[0, 0], clip.intrinsics[:2, 2]
    depth = clip.depth[frame].astype(float)[..., None]
    camera = np.concatenate([(pixel_centres(SIZE) - centre) / focal * depth, depth], axis=-1)
    pose = clip.world_from_camera[frame]
    return camera @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize("family", FAMILIES)
def test_depth_carried_to_a_later_frame_is_the_depth_rendered_there(family: str) -> None:
    clip = clip_of(family, seed=11)
    pose = np.linalg.inv(clip.world_from_camera[4])
    camera = points_of(clip, 0) @ pose[:3, :3].T + pose[:3, 3]
    u = clip.intrinsics[0, 0] * camera[..., 0] / camera[..., 2] + clip.intrinsics[0, 2] - 0.5
    v = clip.intrinsics[1, 1] * camera[..., 1] / camera[..., 2] + clip.intrinsics[1, 2] - 0.5
    rendered = cv2.remap(clip.depth[4], np.float32(u), np.float32(v), cv2.INTER_LINEAR, borderValue=0)
    inside = (rendered > 0) & (camera[..., 2] > 0) & (u > 0) & (v > 0) & (u < SIZE[1] - 1) & (v < SIZE[0] - 1)
    error = np.abs(rendered - camera[..., 2])[inside] / camera[..., 2][inside]
    assert inside.mean() > 0.3
    assert np.median(error) < 0.004
    assert np.mean(error < 0.03) > 0.85  # the rest is hidden in one of the two views
    unmoved = np.abs(clip.depth[4] - clip.depth[0]) / clip.depth[0]
    assert np.median(error) < 0.5 * np.median(unmoved)


@pytest.mark.parametrize("family", FAMILIES)
def test_poses_start_at_the_identity_and_are_rigid_and_smooth(family: str) -> None:
    poses = clip_of(family, seed=5).world_from_camera
    np.testing.assert_array_equal(poses[0], np.eye(4))
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)
    second = np.diff(poses[:, :3, 3], n=2, axis=0)
    first = np.diff(poses[:, :3, 3], axis=0)
    assert np.abs(second).max() < 0.5 * np.abs(first).max() + 1e-6


def tissue_of(shape: tuple[int, int], *, wrap: bool, flat: bool = True) -> object:
    random = np.random.default_rng(0)
    ranges = DOMAINS["source"].material
    grey = np.full((*shape, 3), 0.5, np.float32)
    tissue = make_tissue(random, ranges, grey, (40.0, 40.0), wrap=wrap)
    return tissue._replace(mottle=0.0, bump=0.0, specular=0.0, vessel_tint=(1.0, 1.0, 1.0)) if flat else tissue


LAMP = Lamp(np.zeros((1, 3)), falloff=2.0, spot=0.0, ambient=0.0, soft_mm=0.0)
K = np.array([[40.0, 0.0, 35.0], [0.0, 40.0, 28.0], [0.0, 0.0, 1.0]])


def plane(distance: float) -> Surface:
    heights = np.full((200, 200), distance, np.float32)
    return make_surface(FIELD, heights, first=(-100.0, -100.0), step=(1.0, 1.0), stride_mm=2.0, feature_mm=3.0)


def test_a_plane_has_its_distance_as_depth_everywhere() -> None:
    surface = plane(37.0)
    depth = render(surface, tissue_of((200, 200), wrap=False), LAMP, np.eye(4), K, SIZE).depth
    np.testing.assert_allclose(depth, 37.0, atol=2e-3)


def test_a_cylinder_has_the_depth_of_its_closed_form() -> None:
    radius, shift = 12.0, np.array([3.0, -2.0])
    heights = np.full((800, 512), radius, np.float32)
    heights[-1] = 0.0
    surface = make_surface(
        TUBE,
        heights,
        first=(-10.0, 0.0),
        step=(0.5, 4 / 512),
        stride_mm=1.0,
        feature_mm=3.0,
        centre=np.zeros((800, 2), np.float32),
    )
    camera = np.eye(4)
    camera[:2, 3] = shift
    depth = render(surface, tissue_of((800, 512), wrap=True), LAMP, camera, K, SIZE).depth
    # |shift + z (a, b)| = radius along the ray (a, b, 1)
    slope = (pixel_centres(SIZE) - K[:2, 2]) / 40.0
    a, b, c = (slope**2).sum(-1), slope @ shift, shift @ shift - radius**2
    expected = (-b + np.sqrt(b * b - a * c)) / a
    side = expected < 300.0
    assert side.mean() > 0.9
    np.testing.assert_allclose(depth[side], expected[side], rtol=2e-4, atol=2e-3)


def test_light_falls_off_with_the_stated_power_of_the_distance() -> None:
    lamp = LAMP._replace(offsets=np.array([[4.0, 0.0, 0.0]]), soft_mm=2.0)
    surface, tissue = plane(30.0), tissue_of((200, 200), wrap=False)
    images = {
        p: render(surface, tissue, lamp._replace(falloff=p), np.eye(4), K, SIZE).radiance for p in (0.0, 1.3, 2.0)
    }
    points = np.concatenate([(pixel_centres(SIZE) - K[:2, 2]) / 40.0 * 30.0, np.full((*SIZE, 1), 30.0)], axis=-1)
    reach = np.linalg.norm(points - lamp.offsets[0], axis=-1)
    for power in (1.3, 2.0):
        expected = (20.0 / np.sqrt(reach**2 + 2.0**2)) ** power
        np.testing.assert_allclose(images[power][..., 0] / images[0.0][..., 0], expected, rtol=1e-3)


def test_a_spot_dims_with_the_power_of_the_cosine_to_the_view() -> None:
    surface, tissue = plane(30.0), tissue_of((200, 200), wrap=False)
    even, spot = (render(surface, tissue, LAMP._replace(spot=s), np.eye(4), K, SIZE).radiance for s in (0.0, 2.5))
    slope = (pixel_centres(SIZE) - K[:2, 2]) / 40.0
    cosine = 1 / np.sqrt((slope**2).sum(-1) + 1)
    np.testing.assert_allclose(spot[..., 1] / even[..., 1], cosine**2.5, rtol=1e-3)


def test_hue_of_a_surface_point_does_not_depend_on_the_view() -> None:
    from bathyscope_train.data.synthetic.clip import draw_scene

    domain = DOMAINS["source"].model_copy(update={"families": {"cavity": 1.0}})
    scene: Scene = draw_scene(3, domain)
    tissue = scene.tissue._replace(specular=0.0, mottle=0.0)
    base = np.eye(4)
    base[2, 3] = float(np.median(scene.surface.heights)) - 60.0
    moved = base.copy()
    moved[:3, 3] += (5.0, -3.0, 4.0)
    images = [render(scene.surface, tissue, LAMP, pose, K, SIZE) for pose in (base, moved)]
    depth = images[0].depth.astype(float)[..., None]
    points = np.concatenate([(pixel_centres(SIZE) - K[:2, 2]) / 40.0 * depth, depth], axis=-1) - (5.0, -3.0, 4.0)
    u, v = (np.float32(40.0 * points[..., i] / points[..., 2] + K[i, 2] - 0.5) for i in range(2))
    visible = (u > 0) & (v > 0) & (u < SIZE[1] - 1) & (v < SIZE[0] - 1)
    visible &= np.abs(cv2.remap(images[1].depth, u, v, cv2.INTER_LINEAR) - points[..., 2]) < 0.5
    hues = [np.log(image[..., 1] / image[..., 0]) for image, *_ in images]
    difference = np.abs(hues[0] - cv2.remap(np.float32(hues[1]), u, v, cv2.INTER_LINEAR))[visible]
    assert visible.mean() > 0.4
    assert np.median(difference) < 0.1 * hues[0][visible].std()


def test_noise_repeats_without_a_seam_and_keeps_its_grain() -> None:
    random = np.random.default_rng(1)
    noise = periodic_noise(random, (64, 96), (0.5, 0.25), grain_mm=6.0)
    assert noise.std() == pytest.approx(1.0, abs=1e-3)
    assert np.abs(noise[0] - noise[-1]).max() < 3 * np.abs(np.diff(noise, axis=0)).max()
    per_mm = [np.abs(np.diff(noise, axis=0)).mean() / 0.5, np.abs(np.diff(noise, axis=1)).mean() / 0.25]
    assert per_mm[0] == pytest.approx(per_mm[1], rel=0.35)


def test_gradient_noise_has_unit_slope_and_no_curl() -> None:
    slopes = gradient_noise(np.random.default_rng(2), (32, 32, 32), (0.4, 0.4, 0.4), grain_mm=3.0)
    assert np.sqrt((slopes**2).sum(-1).mean()) == pytest.approx(1.0, abs=1e-3)

    def derivative(field: npt.NDArray[np.float32], axis: int) -> npt.NDArray[np.float32]:
        return np.roll(field, -1, axis) - np.roll(field, 1, axis)

    curl = derivative(slopes[..., 1], 0) - derivative(slopes[..., 0], 1)
    # Central differences leave some; slopes without a common potential would have 1.4 of it.
    assert np.abs(curl).mean() < 0.25 * np.abs(derivative(slopes[..., 1], 0)).mean()

"""Render a clip: frames with exact depth, poses and intrinsics, the same for the same seed."""

from dataclasses import dataclass
from zlib import crc32

import numpy as np
import numpy.typing as npt

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic.cavity import cavity
from bathyscope_train.data.synthetic.domain import Domain, LightRanges, choose, draw
from bathyscope_train.data.synthetic.kernels import render
from bathyscope_train.data.synthetic.lumen import colon, sinus
from bathyscope_train.data.synthetic.optics import Sensor, develop, draw_sensor
from bathyscope_train.data.synthetic.path import camera_path
from bathyscope_train.data.synthetic.scene import Scene
from bathyscope_train.data.synthetic.shading import Lamp

_BUILDERS = {"lumen": colon, "cavity": cavity, "sinus": sinus}


@dataclass(frozen=True, slots=True)
class SyntheticClip:
    """A rendered clip and all that is known about it. Lengths are millimetres."""

    frames: npt.NDArray[np.uint8]
    """``(t, h, w, 3)``, RGB."""
    depth: npt.NDArray[np.float32]
    """``(t, h, w)``: z-depth of the ray through each pixel's centre; 0 outside the field of view."""
    valid: npt.NDArray[np.bool_]
    """``(t, h, w)``: inside the field of view, and the scene is there."""
    world_from_camera: npt.NDArray[np.float64]
    """``(t, 4, 4)``, OpenCV axes; the first is the identity."""
    intrinsics: npt.NDArray[np.float64]
    """``(3, 3)``, in pixels; the first pixel's centre is (0.5, 0.5)."""
    name: str
    seed: int
    domain: str


@dataclass(frozen=True, slots=True)
class ClipPlan:
    """All that decides a clip's radiance, depth and development but the noise: what every renderer starts from."""

    scene: Scene
    lamp: Lamp
    sensor: Sensor
    scene_from_camera: npt.NDArray[np.float64]
    """``(t, 4, 4)``, OpenCV axes."""
    intrinsics: npt.NDArray[np.float64]
    size: tuple[int, int]
    name: str


def draw_scene(seed: int, domain: Domain) -> Scene:
    """The scene that ``render_clip`` films for this seed."""
    random = _stream(seed, domain, "scene")
    return _BUILDERS[choose(random, domain.families)](random, domain.material)


def plan_clip(seed: int, domain: Domain, *, frames: int = 16, size: tuple[int, int] = (112, 140)) -> ClipPlan:
    """Draw everything about a clip but its noise; the same for the same arguments.

    Raises:
        SettingsError: If seed, length or size cannot be used.
    """
    if seed < 0 or frames < 1 or min(size) < 8:
        raise SettingsError(
            f"a clip needs a seed >= 0, at least 1 frame and 8 x 8 pixels; got seed {seed}, {frames} frames, {size}"
        )
    scene = draw_scene(seed, domain)
    random = _stream(seed, domain, "camera")
    fov_deg = _view_angle(random, domain.camera.fov_deg)
    poses = camera_path(random, scene, domain.camera, fov_deg, frames)
    random = _stream(seed, domain, "light")
    return ClipPlan(
        scene=scene,
        lamp=_lamp(random, domain.light, scene),
        sensor=draw_sensor(random, domain.sensor, size),
        scene_from_camera=poses,
        intrinsics=_intrinsics(fov_deg, size),
        size=size,
        name=f"{domain.name}-{scene.family}-{seed:06d}",
    )


def render_clip(seed: int, domain: Domain, *, frames: int = 16, size: tuple[int, int] = (112, 140)) -> SyntheticClip:
    """Render one clip of a scene of its own.

    The same seed, domain, length and size give the same bytes, in any process on the same machine.

    Args:
        seed: Number of the clip, at least 0.
        domain: What scenes, light, camera and sensor may look like.
        frames: Length.
        size: Height and width in pixels.

    Raises:
        SettingsError: If seed, length or size cannot be used.
    """
    plan = plan_clip(seed, domain, frames=frames, size=size)
    radiance, depth = np.empty((frames, *size, 3), np.float32), np.empty((frames, *size), np.float32)
    for index, pose in enumerate(plan.scene_from_camera):
        radiance[index], depth[index] = render(
            plan.scene.surface, plan.scene.tissue, plan.lamp, pose, plan.intrinsics, size
        )
    valid = (plan.sensor.view >= 0.5) & (depth > 0)
    return SyntheticClip(
        frames=develop(_stream(seed, domain, "noise"), radiance, plan.sensor),
        depth=np.where(valid, depth, np.float32(0)),
        valid=valid,
        world_from_camera=from_first_camera(plan.scene_from_camera),
        intrinsics=plan.intrinsics,
        name=plan.name,
        seed=seed,
        domain=domain.name,
    )


def from_first_camera(scene_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The same poses ``(t, 4, 4)`` with the first camera as the world."""
    world_from_camera = np.linalg.inv(scene_from_camera[0]) @ scene_from_camera
    world_from_camera[0] = np.eye(4)
    return world_from_camera


def _stream(seed: int, domain: Domain, what: str) -> np.random.Generator:
    """Independent random numbers for each part of a clip, so that one part can change alone."""
    return np.random.default_rng([seed, crc32(domain.name.encode()), crc32(what.encode())])


def _view_angle(random: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A horizontal field of view in degrees, even in the logarithm of the focal length."""
    low, high = np.log(np.tan(np.radians(bounds) / 2))
    return float(np.degrees(2 * np.arctan(np.exp(random.uniform(low, high)))))


def _intrinsics(fov_deg: float, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    height, width = size
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def _lamp(random: np.random.Generator, ranges: LightRanges, scene: Scene) -> Lamp:
    angle, offset = random.uniform(0, 2 * np.pi), draw(random, ranges.offset_mm)
    arm = offset * np.array([np.cos(angle), np.sin(angle), 0.0])
    pair = random.uniform() < ranges.second_light
    return Lamp(
        offsets=np.stack([arm, -arm] if pair else [arm]),
        falloff=draw(random, ranges.falloff),
        spot=draw(random, ranges.spot),
        ambient=draw(random, ranges.ambient),
        soft_mm=1.5 * scene.surface.feature_mm,
    )

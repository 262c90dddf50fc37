"""Render a clip: frames with exact depth, poses and intrinsics, the same for the same seed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from zlib import crc32

import numpy as np
import numpy.typing as npt

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic.cavity import cavity
from bathyscope_train.data.synthetic.closeup import closeup
from bathyscope_train.data.synthetic.domain import Domain, MaterialRanges, choose
from bathyscope_train.data.synthetic.haze import draw_haze
from bathyscope_train.data.synthetic.indoor import indoor
from bathyscope_train.data.synthetic.instrument import NO_INSTRUMENTS, Instruments, draw_instruments
from bathyscope_train.data.synthetic.kernels import NEAREST_MM, Picture, render
from bathyscope_train.data.synthetic.larynx import larynx
from bathyscope_train.data.synthetic.lens import PINHOLE, Distortion, draw_distortion
from bathyscope_train.data.synthetic.light import draw_lamp
from bathyscope_train.data.synthetic.lumen import colon, sinus
from bathyscope_train.data.synthetic.optics import Sensor, develop, draw_sensor, form_image
from bathyscope_train.data.synthetic.path import camera_path
from bathyscope_train.data.synthetic.scene import NOTHING, Scene
from bathyscope_train.data.synthetic.shading import Lamp
from bathyscope_train.data.synthetic.shutter import image_motion
from bathyscope_train.data.synthetic.solids import joined, placed
from bathyscope_train.data.synthetic.swell import Swell, draw_swell, swollen
from bathyscope_train.data.synthetic.tissue import settle_palette
from bathyscope_train.data.synthetic.tracing import trace

_Image = npt.NDArray[np.float32]
_BUILDERS: dict[str, Callable[[np.random.Generator, MaterialRanges], Scene]] = {
    "lumen": colon,
    "cavity": cavity,
    "sinus": sinus,
    "larynx": larynx,
    "closeup": closeup,
    "indoor": indoor,
}


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
    distortion: Distortion
    """Of the lens: where a pinhole would show x, it shows ``distort(x)``; see ``lens``."""
    mover: npt.NDArray[np.uint8]
    """``(t, h, w)``: 0 on what stands still or only breathes, k on the k-th instrument."""
    world_from_mover: npt.NDArray[np.float64]
    """``(t, m, 4, 4)``: where each instrument is; m may be 0."""
    swell: Swell | None
    """How the tissue moves, if it does."""
    name: str
    seed: int
    domain: str

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """``(t, h, w)``: pixels of instruments, whose motion is not the camera's."""
        return self.mover > 0


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
    distortion: Distortion = PINHOLE
    instruments: Instruments = NO_INSTRUMENTS
    """Where ``m`` is 0, the scene's solids are all there is."""
    swell: Swell | None = None

    def scene_at(self, frame: int) -> Scene:
        """The scene as it is in one frame: the tissue swollen, the instruments in place."""
        scene = self.scene
        if self.instruments.scene_from_mover.shape[1]:
            moving = placed(self.instruments.solids, self.instruments.scene_from_mover[frame])
            scene = scene._replace(solids=joined(scene.solids, moving))
        if self.swell is not None:
            scene = scene._replace(surface=swollen(scene.surface, self.swell, frame))
        return scene


def draw_scene(seed: int, domain: Domain) -> Scene:
    """The scene that ``render_clip`` films for this seed."""
    random = _stream(seed, domain, "scene")
    build = _BUILDERS[choose(random, domain.families)]
    return build(random, settle_palette(random, domain.material))


def plan_clip(
    seed: int,
    domain: Domain,
    *,
    frames: int = 16,
    size: tuple[int, int] = (112, 140),
    take: int = 0,
    scene: Scene | None = None,
) -> ClipPlan:
    """Draw everything about a clip but its noise; the same for the same arguments.

    Args:
        seed: Number of the clip, at least 0.
        domain: What scenes, light, camera and sensor may look like.
        frames: Length.
        size: Height and width in pixels.
        take: Which of the clips in this scene: each has another camera, light and sensor; 0 is ``render_clip``'s.
        scene: The seed's scene, where it is known already.

    Raises:
        SettingsError: If seed, length or size cannot be used.
    """
    if seed < 0 or frames < 1 or min(size) < 8:
        raise SettingsError(
            f"a clip needs a seed >= 0, at least 1 frame and 8 x 8 pixels; got seed {seed}, {frames} frames, {size}"
        )
    scene = draw_scene(seed, domain) if scene is None else scene
    stream = partial(_stream, seed, domain, take=take)
    random = stream("camera")
    fov_deg = _view_angle(random, domain.camera.fov_deg)
    poses = camera_path(random, stream("hand"), scene, domain.camera, fov_deg, frames)
    intrinsics = _intrinsics(fov_deg, size)
    reach = float(np.hypot(*size)) / 2 / intrinsics[0, 0]
    random = stream("life")
    instruments = NO_INSTRUMENTS
    if random.uniform() < domain.life.instruments and scene.surface.kind != NOTHING:
        slopes = intrinsics[0, 2] / intrinsics[0, 0], intrinsics[1, 2] / intrinsics[1, 1]
        instruments = draw_instruments(random, poses, slopes, partial(_depth_along, scene, poses[0]))
    swell = draw_swell(stream("swell"), domain.life, scene.surface)
    random = stream("light")
    return ClipPlan(
        scene=scene,
        lamp=draw_lamp(random, domain.light, soft_mm=1.5 * scene.surface.feature_mm),
        sensor=draw_sensor(random, domain.sensor, size, draw_haze(stream("air"), domain.air)),
        scene_from_camera=poses,
        intrinsics=intrinsics,
        size=size,
        name=f"{domain.name}-{scene.family}-{seed:06d}" + (f".{take}" if take else ""),
        distortion=draw_distortion(stream("lens"), domain.camera, reach),
        instruments=instruments,
        swell=swell,
    )


def render_frame_of(plan: ClipPlan, frame: int) -> Picture:
    """Radiance, depth and movers of one frame of a plan."""
    scene = plan.scene_at(frame)
    return render(
        scene.surface,
        scene.tissue,
        plan.lamp,
        plan.scene_from_camera[frame],
        plan.intrinsics,
        plan.size,
        solids=scene.solids,
        distortion=plan.distortion,
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
    mover = np.empty((frames, *size), np.uint8)
    for index in range(frames):
        radiance[index], depth[index], mover[index] = render_frame_of(plan, index)
    valid = (plan.sensor.view >= 0.5) & (depth > 0)
    world_from_scene = np.linalg.inv(plan.scene_from_camera[0])
    swell = plan.swell
    return SyntheticClip(
        frames=develop(_stream(seed, domain, "noise"), _formed(plan, radiance, depth), plan.sensor),
        depth=np.where(valid, depth, np.float32(0)),
        valid=valid,
        world_from_camera=from_first_camera(plan.scene_from_camera),
        intrinsics=plan.intrinsics,
        distortion=plan.distortion,
        mover=np.where(valid, mover, np.uint8(0)),
        world_from_mover=world_from_scene @ plan.instruments.scene_from_mover,
        swell=None if swell is None else swell._replace(scene_from_world=plan.scene_from_camera[0]),
        name=plan.name,
        seed=seed,
        domain=domain.name,
    )


def _formed(plan: ClipPlan, radiance: _Image, depth: _Image) -> _Image:
    """What reaches the chip; instruments smear as what stands still beside them does."""
    motion = None
    if plan.sensor.timed:
        motion = image_motion(depth, plan.scene_from_camera, plan.intrinsics, plan.distortion)
    return form_image(radiance, depth, motion, float(plan.intrinsics[0, 0]), plan.sensor)


def from_first_camera(scene_from_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The same poses ``(t, 4, 4)`` with the first camera as the world."""
    world_from_camera = np.linalg.inv(scene_from_camera[0]) @ scene_from_camera
    world_from_camera[0] = np.eye(4)
    return world_from_camera


def _stream(seed: int, domain: Domain, what: str, *, take: int = 0) -> np.random.Generator:
    """Independent random numbers for each part of a clip, so that one part can change alone."""
    numbers = [seed, crc32(domain.name.encode()), crc32(what.encode())]
    return np.random.default_rng([*numbers, take] if take else numbers)


def _view_angle(random: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A horizontal field of view in degrees, even in the logarithm of the focal length."""
    low, high = np.log(np.tan(np.radians(bounds) / 2))
    return float(np.degrees(2 * np.arctan(np.exp(random.uniform(low, high)))))


def _intrinsics(fov_deg: float, size: tuple[int, int]) -> npt.NDArray[np.float64]:
    height, width = size
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def _depth_along(scene: Scene, pose: npt.NDArray[np.float64], x: float, y: float) -> float:
    """z-depth of the tissue at a slope (x / z, y / z) of a camera."""
    slant = float(np.sqrt(x * x + y * y + 1.0))
    ray = pose[:3, :3] @ (x / slant, y / slant, 1.0 / slant)
    return float(trace(scene.surface, NEAREST_MM, *(float(value) for value in (*pose[:3, 3], *ray)))) / slant

"""Camera paths through a scene: forwards, sideways, turning, round a point, nearly still; with pauses and tremor."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from bathyscope.errors import GeometryError
from bathyscope_train.data.synthetic.domain import CameraRanges, choose, draw
from bathyscope_train.data.synthetic.scene import NOTHING, TUBE, Scene, Stage, Surface
from bathyscope_train.data.synthetic.solid_tracing import solid_clearance
from bathyscope_train.data.synthetic.solids import frame_towards
from bathyscope_train.data.synthetic.tracing import clearance, free_depth

Array = npt.NDArray[np.float64]


class _Manner(NamedTuple):
    """How far a kind of path goes along the view, across it, and round, against the usual."""

    along: float
    across: float
    turn: float


_MANNERS = {
    "forward": _Manner(1.3, 0.5, 0.6),
    "sideways": _Manner(0.35, 1.6, 0.7),
    "turning": _Manner(0.5, 0.5, 1.6),
    "still": _Manner(0.05, 0.08, 0.15),
    "orbit": _Manner(0.3, 2.0, 0.1),
    "parallel": _Manner(0.3, 1.5, 0.1),
}
_TRIES = 60
_SHARE_PER_FRAME = 0.03  # of the mean depth, moved in one frame at speed 1
_TURN_DEG = 11.0  # amplitude of the slow swing at speed 1 and a view of 80 degrees
_BESIDE_THE_WALL = 0.5, 0.85  # of the radius from the middle of a tube


def _swing(random: np.random.Generator, frames: int, periods: tuple[float, float] = (26.0, 60.0)) -> Array:
    """A smooth signal of amplitude about 1 with value 0 at the first frame."""
    time = np.arange(frames)
    signal = np.zeros(frames)
    for share in (0.75, 0.35):
        phase, period = random.uniform(0, 2 * np.pi), random.uniform(*periods) * (1.0 if share > 0.5 else 0.5)
        signal += share * (np.sin(2 * np.pi * time / period + phase) - np.sin(phase))
    return signal


def _look(forward: Array, yaw: Array, pitch: Array, roll: Array) -> Array:
    """Rotations ``(t, 3, 3)`` whose z axis is ``forward`` turned by yaw, pitch and roll (radians)."""
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    frame = np.stack([right, np.cross(forward, right), forward], axis=-1)
    one, zero = np.ones_like(yaw), np.zeros_like(yaw)

    def turn(rows: list[Array]) -> Array:
        return np.stack(rows, axis=-1).reshape(-1, 3, 3)

    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    yawed = turn([cy, zero, sy, zero, one, zero, -sy, zero, cy])
    pitched = turn([one, zero, zero, zero, cp, -sp, zero, sp, cp])
    rolled = turn([cr, -sr, zero, sr, cr, zero, zero, zero, one])
    return frame @ yawed @ pitched @ rolled


def camera_path(  # noqa: PLR0917 - what decides the path, in the order of its making
    random: np.random.Generator,
    hand: np.random.Generator,
    scene: Scene,
    ranges: CameraRanges,
    fov_deg: float,
    frames: int,
) -> Array:
    """Draw a path of poses, ``scene_from_camera`` ``(t, 4, 4)``.

    Args:
        random: Source of the path.
        hand: Source of slowness, pauses, tremor and nearness to the wall, so that a path is the same without them.
        scene: Where the camera moves.
        ranges: Speeds and kinds of path.
        fov_deg: Horizontal field of view; narrow views move and turn less.
        frames: Length of the path.
    """
    kind = choose(random, ranges.motions)
    manner = _MANNERS[kind]
    speed = draw(random, ranges.speed)
    if hand.uniform() < ranges.slow:
        speed = float(np.exp(hand.uniform(*np.log(ranges.slow_speed))))
    pace = speed * min(1.0, fov_deg / 80.0)
    if scene.stage is not None:
        positions, forward = _on_stage(random, scene, scene.stage, manner, pace, frames)
    elif scene.surface.kind == TUBE:
        wall = hand.spawn(1)[0]
        near = wall if wall.uniform() < ranges.hugging else None
        positions, forward = _through_tube(random, near, scene.surface, manner, pace, frames)
    else:
        positions, forward = _over_field(random, scene.surface, manner, pace, frames)
    if kind == "orbit":
        forward = _round(positions, forward)
    elif kind == "parallel":
        forward = np.broadcast_to(forward[:1], forward.shape)

    swing = np.radians(_TURN_DEG) * manner.turn * pace
    gaze = np.radians(fov_deg) * 0.22
    level = scene.stage is not None and scene.stage.upright
    if level:
        gaze *= 0.5
    yaw = swing * _swing(random, frames) + random.uniform(-gaze, gaze)
    pitch = swing * _swing(random, frames) + random.uniform(-gaze, gaze)
    roll = 1.2 * swing * _swing(random, frames) + random.uniform(-np.pi, np.pi) * (0.05 if level else 1.0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = _look(forward, yaw, pitch, roll)
    poses[:, :3, 3] = positions
    if hand.uniform() < ranges.pausing:
        poses = _paused(hand, poses)
    if hand.uniform() < ranges.trembling:
        poses = _shaken(hand, poses, scene, draw(hand, ranges.tremor_deg), float(np.linalg.norm(forward[0])))
    return poses


def _round(positions: Array, forward: Array) -> Array:
    """Towards one point all the time."""
    return np.asarray(positions[0] + forward[0] - positions)


def _paused(hand: np.random.Generator, poses: Array) -> Array:
    """The same path, with one or two stops on the way and so not quite to its end."""
    frames = len(poses)
    speed = np.ones(frames)
    for _ in range(int(hand.integers(1, 3))):
        start, length = hand.uniform(0, frames), hand.uniform(2, max(3.0, 0.6 * frames))
        edge = np.abs(np.arange(frames) - start - length / 2) - length / 2
        speed *= np.clip(0.5 + edge / 2.0, 0.0, 1.0)
    time = np.concatenate([[0.0], np.cumsum(speed)[:-1]])
    return _at(poses, np.clip(time, 0, frames - 1))


def _at(poses: Array, time: Array) -> Array:
    """Poses between the frames of a path: positions on the chord, rotations on the arc."""
    if len(poses) == 1:
        return poses[np.zeros(len(time), int)]
    rotations = Slerp(np.arange(len(poses)), Rotation.from_matrix(poses[:, :3, :3]))(time)
    between = np.tile(np.eye(4), (len(time), 1, 1))
    between[:, :3, :3] = rotations.as_matrix()
    for axis in range(3):
        between[:, axis, 3] = np.interp(time, np.arange(len(poses)), poses[:, axis, 3])
    return between


def _shaken(hand: np.random.Generator, poses: Array, scene: Scene, tremor_deg: float, distance: float) -> Array:
    """The same path in a hand that trembles; the shifts are left out where they would touch something."""
    time = np.arange(len(poses))[:, None]
    signal = np.zeros((len(poses), 6))
    for _ in range(3):
        period, phase = hand.uniform(2.2, 9.0, 6), hand.uniform(0, 2 * np.pi, 6)
        signal += hand.uniform(0.2, 1.0, 6) * np.sin(2 * np.pi * time / period + phase) / 1.5
    amplitude = np.radians(tremor_deg)
    shaken = poses.copy()
    shaken[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(amplitude * signal[:, :3]).as_matrix()
    moved = poses[:, :3, 3] + hand.uniform(0.0, 1.0) * amplitude * distance * signal[:, 3:]
    before = min(_room(scene, point, 0.0) for point in poses[:, :3, 3])
    if min(_room(scene, point, 0.0) for point in moved) > 0.7 * before:
        shaken[:, :3, 3] = moved
    return shaken


def _room(scene: Scene, point: Array, aside_mm: float) -> float:
    """How far a point is from everything, roughly: of a surface the least within ``aside_mm`` to the sides."""
    x, y, z = (float(value) for value in point)
    free = solid_clearance(scene.solids, x, y, z)
    if scene.surface.kind == NOTHING:
        return free
    for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        free = min(free, free_depth(scene.surface, x + dx * aside_mm, y + dy * aside_mm, z))
    return free


def _keep_clear(surface: Surface, base: Array, offset: Array, margin_mm: float) -> Array:
    """Positions ``base + offset``, the offset shrunk until every one is ``margin_mm`` from the wall."""
    for share in (1.0, 0.75, 0.5, 0.3, 0.15, 0.0):
        positions = base + share * offset
        if min(clearance(surface, point) for point in positions) >= margin_mm:
            return positions
    raise GeometryError(
        f"no camera path keeps {margin_mm:.1f} mm from the walls; widen the lumen or lower its folds and polyps"
    )


def _through_tube(  # noqa: PLR0917 - as above
    random: np.random.Generator,
    wall: np.random.Generator | None,
    surface: Surface,
    manner: _Manner,
    pace: float,
    frames: int,
) -> tuple[Array, Array]:
    """Along the centreline; with ``wall``, the source of how, near the wall and looking further ahead."""
    rows = len(surface.centre)
    z = surface.first[0] + surface.step[0] * np.arange(rows)
    radius = float(np.median(surface.heights[rows // 4 : -rows // 4]))
    step = _SHARE_PER_FRAME * 2.2 * radius * pace * manner.along
    ends = z[0] + 1.6 * radius, z[-1] - 2.2 * radius
    travel = min(step * frames, ends[1] - ends[0]) * (-1.0 if random.uniform() < 0.3 else 1.0)
    start = random.uniform(ends[0] + max(0.0, -travel), ends[1] - max(0.0, travel))
    ease = 0.15 * abs(travel) * _swing(random, frames) / max(1.0, frames / 8)
    along = np.clip(start + travel * np.arange(frames) / max(1, frames) + ease, *ends)

    def centre(at: Array) -> Array:
        return np.stack([np.interp(at, z, surface.centre[:, axis]) for axis in range(2)] + [at], axis=-1)

    offset = np.zeros((frames, 3))
    for axis in range(2):
        amplitude = 0.22 * radius * pace * manner.across
        offset[:, axis] = amplitude * _swing(random, frames) + random.uniform(-0.3, 0.3) * radius
    base = centre(along)
    ahead, margin = random.uniform(1.6, 3.0), 0.12
    if wall is not None:
        side, share = wall.uniform(0, 2 * np.pi), wall.uniform(*_BESIDE_THE_WALL)
        offset += share * radius * np.array([np.cos(side), np.sin(side), 0.0]) - 0.7 * offset[0]
        ahead, margin = wall.uniform(2.0, 6.0), 0.07
    positions = _keep_clear(surface, base, offset, margin * radius)
    return positions, centre(along + ahead * radius) - positions


def _over_field(
    random: np.random.Generator, surface: Surface, manner: _Manner, pace: float, frames: int
) -> tuple[Array, Array]:
    extent = surface.step[0] * surface.heights.shape[0]
    middle = float(np.median(surface.heights))
    distance = random.uniform(0.12, 0.34) * extent
    step = 1.9 * _SHARE_PER_FRAME * distance * pace
    target = np.append(random.uniform(-0.14, 0.14, 2) * extent, middle)
    base = np.append(random.uniform(-0.12, 0.12, 2) * extent, middle - distance)
    offset = np.zeros((frames, 3))
    for axis, share in enumerate((manner.across, manner.across, manner.along)):
        drift = random.choice([-1.0, 1.0]) * random.uniform(0.3, 1.0) * np.arange(frames)
        offset[:, axis] = step * share * (0.6 * drift + 4.0 * _swing(random, frames))
    limit = 0.9 * distance
    offset *= min(1.0, limit / max(1e-6, float(np.abs(offset).max())))
    floor = min(clearance(surface, base + share * point) for share in (0.0, 0.3, 1.0) for point in offset)
    base[2] -= max(0.0, 0.08 * extent - floor)
    positions = _keep_clear(surface, np.tile(base, (frames, 1)), offset, 0.05 * extent)
    return positions, target - positions


def _on_stage(  # noqa: PLR0917 - as above
    random: np.random.Generator, scene: Scene, stage: Stage, manner: _Manner, pace: float, frames: int
) -> tuple[Array, Array]:
    """Round the stage's target, at its distance; the offset shrinks, or another place is tried, until it is clear."""
    for _ in range(_TRIES):
        target = np.array(stage.target) + random.uniform(-1, 1, 3) * stage.spread_mm
        slant, azimuth = np.radians(random.uniform(*stage.slant_deg)), random.uniform(0, 2 * np.pi)
        frame = frame_towards(np.array(stage.back), np.zeros(3))[:3, :3]
        away = frame @ (np.sin(slant) * np.cos(azimuth), np.sin(slant) * np.sin(azimuth), np.cos(slant))
        distance = random.uniform(*stage.distance_mm)
        base = target + distance * away
        if _room(scene, base, stage.margin_mm) < stage.margin_mm:
            continue
        axes = frame_towards(away, np.zeros(3))[:3, :3]
        step = 1.9 * _SHARE_PER_FRAME * distance * pace
        local = np.zeros((frames, 3))
        for axis, share in enumerate((manner.across, manner.across, manner.along)):
            drift = random.choice([-1.0, 1.0]) * random.uniform(0.3, 1.0) * np.arange(frames)
            local[:, axis] = step * share * (0.6 * drift + 4.0 * _swing(random, frames))
        local *= min(1.0, 0.7 * distance / max(1e-6, float(np.abs(local).max())))
        offset = local @ axes.T
        follow = random.uniform(0.0, 1.0)
        for share in (1.0, 0.75, 0.5, 0.3, 0.15):
            positions = base + share * offset
            if min(_room(scene, point, stage.margin_mm) for point in positions) >= stage.margin_mm:
                return positions, target + follow * share * offset - positions
    raise GeometryError(
        f"no camera path of {frames} frames in a scene of the family {scene.family} keeps {stage.margin_mm:.1f} mm "
        "from everything; lower the speed of the domain's camera"
    )

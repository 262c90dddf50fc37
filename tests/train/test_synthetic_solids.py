"""Rays meet boxes, rooms, balls and cones where closed forms say, with the normals of the shapes."""

import numpy as np
import numpy.typing as npt
import pytest

from bathyscope_train.data.synthetic import DOMAINS
from bathyscope_train.data.synthetic.kernels import Picture, render
from bathyscope_train.data.synthetic.lens import Distortion, undistort
from bathyscope_train.data.synthetic.scene import FIELD, Surface, make_surface
from bathyscope_train.data.synthetic.shading import Lamp
from bathyscope_train.data.synthetic.solid_tracing import local_normal, solid_clearance, trace_solids
from bathyscope_train.data.synthetic.solids import (
    BALL,
    BOX,
    FRUSTUM,
    ROOM,
    Look,
    Part,
    Solids,
    frame_towards,
    joined,
    make_solids,
    placed,
)
from bathyscope_train.data.synthetic.tissue import make_tissue

SIZE = (48, 60)
K = np.array([[36.0, 0.0, 30.0], [0.0, 36.0, 24.0], [0.0, 0.0, 1.0]])
GREY = Look((0.5, 0.5, 0.5))
LAMP = Lamp(np.zeros((1, 3)), falloff=2.0, spot=0.0, ambient=0.0, soft_mm=0.0)
Array = npt.NDArray[np.float64]


def wall(distance: float) -> Surface:
    heights = np.full((200, 200), distance, np.float32)
    return make_surface(FIELD, heights, first=(-100.0, -100.0), step=(1.0, 1.0), stride_mm=2.0, feature_mm=3.0)


def picture(solids: Solids, *, distance: float = 60.0, distortion: Distortion | None = None) -> Picture:
    grey = np.full((200, 200, 3), 0.5, np.float32)
    tissue = make_tissue(np.random.default_rng(0), DOMAINS["source"].material, grey, (40.0, 40.0), wrap=False)
    lens = distortion or Distortion()
    return render(wall(distance), tissue, LAMP, np.eye(4), K, SIZE, solids=solids, distortion=lens)


def slopes(distortion: Distortion | None = None) -> Array:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    points = (np.stack([columns + 0.5, rows + 0.5], axis=-1) - K[:2, 2]) / 36.0
    return undistort(points, distortion) if distortion is not None else points


def at(x: float, y: float, z: float) -> Array:
    frame = np.eye(4)
    frame[:3, 3] = x, y, z
    return frame


def test_a_ball_stands_before_the_tissue_where_its_closed_form_says() -> None:
    centre, radius = np.array([4.0, -3.0, 30.0]), 6.0
    shown = picture(make_solids([Part(BALL, at(*centre), (radius,) * 3, GREY, mover=1)]))
    ray = np.concatenate([slopes(), np.ones((*SIZE, 1))], axis=-1)
    a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - radius**2
    hit = b * b - a * c > 0
    expected = np.where(hit, (b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a, 60.0)
    assert 0.02 < hit.mean() < 0.5
    np.testing.assert_allclose(shown.depth, expected, rtol=1e-4)
    np.testing.assert_array_equal(shown.mover, hit)


def test_the_front_of_a_box_has_its_distance_and_ends_at_its_edges() -> None:
    shown = picture(make_solids([Part(BOX, at(2.0, 1.0, 25.0), (8.0, 5.0, 5.0), GREY)]))
    x, y = np.moveaxis(slopes(), -1, 0) * 20.0
    front = (np.abs(x - 2.0) < 8.0) & (np.abs(y - 1.0) < 5.0)
    np.testing.assert_allclose(shown.depth[front], 20.0, rtol=1e-6)
    assert (shown.mover == 0).all()
    assert (shown.depth[~front] > 20.0).all()


def test_a_room_has_the_depth_of_its_walls_from_inside_even_through_a_bent_lens() -> None:
    half, lens = np.array([30.0, 20.0, 45.0]), Distortion(-0.2, 0.05)
    x, y = np.moveaxis(slopes(lens), -1, 0)
    expected = np.minimum(45.0, np.minimum(30.0 / np.abs(x), 20.0 / np.abs(y)))
    shown = picture(make_solids([Part(ROOM, np.eye(4), (30.0, 20.0, 45.0), GREY)]), distortion=lens)
    assert (half > 0).all()
    np.testing.assert_allclose(shown.depth, expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(3.0, 3.0, 9.0), (5.0, 1.0, 7.0), (0.0, 4.0, 6.0)], ids=["rod", "taper", "cone"])
def test_a_frustum_is_met_first_where_fine_steps_along_the_ray_first_enter_it(size: tuple[float, float, float]) -> None:
    random = np.random.default_rng(1)
    frame = frame_towards(np.array([0.3, 0.5, 0.8]), np.array([1.0, -2.0, 3.0]), roll=0.4)
    solids = make_solids([Part(FRUSTUM, frame, size, GREY)])
    back = np.linalg.inv(frame)
    steps = np.linspace(0.0, 60.0, 60_001)
    hits = 0
    for _ in range(60):
        origin = random.normal(0, 1, 3)
        origin *= 25.0 / np.linalg.norm(origin)
        ray = frame[:3, 3] + random.uniform(-4, 4, 3) - origin
        ray /= np.linalg.norm(ray)
        local = (origin + steps[:, None] * ray) @ back[:3, :3].T + back[:3, 3]
        radius = 0.5 * (size[0] + size[1]) + 0.5 * (size[1] - size[0]) / size[2] * local[:, 2]
        inside = (np.hypot(local[:, 0], local[:, 1]) < radius) & (np.abs(local[:, 2]) < size[2])
        t, which = trace_solids(solids, 0.0, 1e9, *origin, *ray)
        if inside.any():
            hits += 1
            assert which == 0
            assert t == pytest.approx(steps[inside.argmax()], abs=2e-3)
        else:
            assert which == -1 or inside.sum() == 0
    assert hits > 20


def test_normals_are_the_slope_of_the_distance_to_the_solid() -> None:
    shapes = [(BOX, (4.0, 3.0, 2.0)), (BALL, (3.0,) * 3), (FRUSTUM, (3.0, 3.0, 5.0)), (ROOM, (9.0, 8.0, 7.0))]
    for kind, size in shapes:
        solids = make_solids([Part(kind, np.eye(4), size, GREY)])
        for direction in np.random.default_rng(2).normal(0, 1, (30, 3)):
            ray = direction / np.linalg.norm(direction)
            start = 0.0 if kind == ROOM else 20.0
            way = ray if kind == ROOM else -ray
            t, _ = trace_solids(solids, 0.0, 1e9, *(start * ray), *way)
            point = start * ray + t * way
            observed = np.array(local_normal(kind, solids.size[0], *point))
            outside = point + 1e-3 * observed
            beyond, before = (
                np.array([solid_clearance(solids, *(outside + s * d)) for d in 1e-5 * np.eye(3)]) for s in (1.0, -1.0)
            )
            np.testing.assert_allclose(observed, (beyond - before) / 2e-5, atol=1e-3)


def test_movers_move_and_the_rest_stays() -> None:
    still = make_solids([Part(BALL, at(0.0, 0.0, 50.0), (5.0,) * 3, GREY)])
    moving = make_solids([Part(BALL, at(0.0, 0.0, 2.0), (1.0,) * 3, GREY, mover=1)])
    both = joined(still, placed(moving, at(3.0, 0.0, 10.0)[None]))
    assert trace_solids(both, 0.0, 1e9, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0) == (45.0, 0)
    assert trace_solids(both, 0.0, 1e9, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0) == (11.0, 1)
    np.testing.assert_array_equal(moving.local_from_scene[0, :, 3], (0.0, 0.0, -2.0))


def test_a_lamp_in_the_room_does_not_light_what_another_solid_hides() -> None:
    lights = np.array([[0.0, -18.0, 30.0, 1.0]])
    floor = Part(BOX, at(0.0, 20.0, 40.0), (60.0, 1.0, 60.0), GREY)
    lid = Part(BOX, at(0.0, 0.0, 30.0), (3.0, 0.5, 3.0), GREY)
    shown = [
        picture(make_solids(parts, lights=lights, sky=0.0, lamp_share=0.0), distance=90.0).radiance
        for parts in ([floor], [floor, lid])
    ]
    below = tuple(np.rint(36.0 * np.array([19.0 / 34.0, 0.0]) + (24, 30)).astype(int))  # floor at z = 34, x = 0
    assert shown[1][below][0] == pytest.approx(0.12 * shown[0][below][0], rel=1e-3)
    corner = shown[0].shape[0] - 1, 0
    np.testing.assert_allclose(shown[1][corner], shown[0][corner])

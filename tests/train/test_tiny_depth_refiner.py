"""Parallax and the focal length: least-squares steps lead back to the truth that made the matches."""

import math

import torch

from bathyscope_train.losses.depth import normal_loss, surface_normals
from bathyscope_train.model.depth_refiner import DepthRefiner, parallax, spread_queries
from bathyscope_train.model.focal_layer import focal_step, fuse_focal
from bathyscope_train.model.pose_layer import Motion, project, rays, solve_motion
from bathyscope_train.model.rigid import rotation_exponential

FOCAL = torch.tensor([24.0])


def seen(turn: float, shift: float, count: int = 200) -> tuple[torch.Tensor, torch.Tensor, Motion, torch.Tensor]:
    """Queries (q, 2), their depths (1, q), a motion, and where they are seen after it."""
    random = torch.Generator().manual_seed(4)
    queries = (torch.rand(count, 2, generator=random) - 0.5) * torch.tensor([34.0, 27.0])
    depth = 0.6 + torch.rand(1, count, generator=random)
    angles = turn * torch.tensor([[0.6, -0.8, 0.2]])
    motion = Motion(rotation_exponential(angles), shift * torch.tensor([[0.8, 0.1, 0.6]]))
    points = rays(queries.expand(1, -1, 2), FOCAL[:, None].expand(depth.shape)) * depth[..., None]
    return queries, depth, motion, project(points, motion, FOCAL)


def test_parallax_leads_from_a_wrong_depth_to_the_true_one() -> None:
    queries, true, motion, matches = seen(turn=0.1, shift=0.15)
    depth = true * torch.linspace(0.85, 1.15, true.shape[1])
    for _ in range(4):
        points = rays(queries.expand(1, -1, 2), FOCAL[:, None].expand(depth.shape)) * depth[..., None]
        gradient, curvature = parallax(points, matches, torch.ones_like(matches), FOCAL, motion)
        depth = depth * (gradient / curvature.clamp_min(1e-6)).clamp(-0.5, 0.5).exp()
    moving = curvature > 0.5 * curvature.median()  # the others lie where the camera goes and do not move sideways
    torch.testing.assert_close(depth[moving], true[moving], atol=0, rtol=1e-2)


def test_a_camera_that_only_turns_says_nothing_about_depth() -> None:
    queries, depth, motion, matches = seen(turn=0.2, shift=0.0)
    points = rays(queries.expand(1, -1, 2), FOCAL[:, None].expand(depth.shape)) * depth[..., None]
    _, curvature = parallax(points, matches, torch.ones_like(matches), FOCAL, motion)
    assert float(curvature.abs().max()) < 1e-6


def solved_focal(turn: float, first: float, prior: float) -> float:
    """Focal length after eight steps from ``first`` times the true one, motions solved again before each."""
    queries, depth, motion, matches = seen(turn=turn, shift=0.05)
    trust, shift = torch.ones_like(matches), torch.zeros(1)
    for _ in range(8):
        focal = FOCAL * first * shift.exp()
        points = rays(queries.expand(1, -1, 2), focal[:, None].expand(depth.shape)) * depth[..., None]
        solution = solve_motion(points, matches, trust, focal, Motion.none(motion.translation), iterations=6)
        gradient, curvature = focal_step(queries, depth, matches, trust, focal=focal, motion=solution.motion)
        shift = shift + fuse_focal(gradient[None], curvature[None], shift, torch.tensor(prior))
    return float(first * shift.exp())


def test_a_turning_camera_reveals_its_focal_length() -> None:
    assert abs(math.log(solved_focal(turn=0.35, first=1.3, prior=0.0))) < 0.02
    assert abs(math.log(solved_focal(turn=0.35, first=0.8, prior=0.0))) < 0.02


def test_a_camera_that_hardly_turns_leaves_the_first_estimate() -> None:
    assert abs(math.log(solved_focal(turn=0.005, first=1.3, prior=20.0) / 1.3)) < 0.05


def test_the_steps_of_the_focal_length_are_those_of_the_squared_residuals() -> None:
    """Finite differences of the sum of squares after solving for the motion again."""
    queries, depth, motion, matches = seen(turn=0.3, shift=0.1)
    trust = torch.ones_like(matches, dtype=torch.float64)
    queries, depth, matches = queries.double(), depth.double(), matches.double()
    start = Motion(motion.rotation.double(), motion.translation.double())

    def residual(log_focal: float) -> tuple[torch.Tensor, Motion, torch.Tensor]:
        focal = FOCAL.double() * math.exp(log_focal)
        points = rays(queries.expand(1, -1, 2), focal[:, None].expand(depth.shape)) * depth[..., None]
        found = solve_motion(points, matches, trust, focal, start, iterations=30)
        error = matches - project(points, found.motion, focal)
        return 0.5 * error.square().sum() / depth.shape[1], found.motion, focal

    at, step = 0.1, 1e-3
    slope = (residual(at + step)[0] - residual(at - step)[0]) / (2 * step)
    cost, solved, focal = residual(at)
    gradient, _ = focal_step(queries, depth, matches, trust, focal=focal, motion=solved)
    # Half the sum over both coordinates of a point is the mean square of a coordinate: the variance.
    torch.testing.assert_close(-gradient[0] * (cost + 0.02), slope, rtol=0.05, atol=1e-6)


def test_values_at_the_queries_stay_there_and_are_linear_in_between() -> None:
    columns = torch.arange(5.0).expand(1, 4, 5)
    spread = spread_queries(columns, torch.zeros(1, 28, 36))
    # Query k sits between the pixels 8 k + 1 and 8 k + 2.
    torch.testing.assert_close(spread[0, 10, 8:12].mean(), torch.tensor(1.0))
    torch.testing.assert_close(spread[0, :, 13:15].mean(), torch.tensor(1.5))
    assert float(spread[0, 0, 0]) == 0.0
    assert float(spread[0, 0, -1]) == 4.0


def test_a_fresh_refiner_changes_nothing_and_learns_to_follow_parallax() -> None:
    torch.manual_seed(0)
    refiner = DepthRefiner(context=4, width=16)
    gradient, curvature = torch.randn(1, 2, 12), torch.full((1, 2, 12), 4.0)
    inputs = (gradient, curvature, torch.zeros(1, 2, 12), torch.zeros(12, 2), torch.zeros(1, 2, 4, 3, 4))
    assert not refiner(*inputs).any()
    optimizer = torch.optim.Adam(refiner.parameters(), lr=1e-2)
    for _ in range(150):
        optimizer.zero_grad()
        loss = (refiner(*inputs) - gradient / 5).abs().mean()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.3 * float((gradient / 5).abs().mean())


def test_a_wall_at_sixty_degrees_costs_half_against_one_seen_head_on() -> None:
    focal, size = 1000.0, 9
    x = (torch.arange(size) + 0.5 - size / 2) / focal
    slanted = (1 / (1 - math.tan(math.radians(60)) * x)).expand(1, 1, size, size)
    flat, valid = torch.ones(1, 1, size, size), torch.ones(1, 1, size, size, dtype=torch.bool)
    cost = normal_loss(slanted, flat, valid, torch.tensor([focal]))
    torch.testing.assert_close(cost, torch.tensor(0.5), atol=5e-3, rtol=0)
    torch.testing.assert_close(
        surface_normals(flat, torch.tensor([focal]))[0, 0, 3, 3].abs(), torch.tensor([0.0, 0.0, 1.0]), atol=1e-4, rtol=0
    )
    assert float(normal_loss(3 * slanted, slanted, valid, torch.tensor([focal]))) < 1e-5

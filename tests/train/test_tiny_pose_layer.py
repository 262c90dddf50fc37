"""The solver recovers known camera motion from exact projections, and its pieces agree with linear algebra."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bathyscope_train.model.pose_layer import Motion, project, solve_motion, solve_positive
from bathyscope_train.model.rigid import adjoint, compose, relative_motion, rotation_exponential, rotation_logarithm

FOCAL_CELLS = torch.tensor([20.0, 17.0])


def two_scenes(count: int = 80) -> tuple[torch.Tensor, Motion]:
    """Points at depth 0.4 to 2 before two cameras, and a motion of about 9 degrees and 0.15 for each."""
    random = torch.Generator().manual_seed(3)
    depth = 0.4 + 1.6 * torch.rand(2, count, generator=random)
    plane = torch.rand(2, count, 2, generator=random) * 1.4 - 0.7
    points = torch.cat([plane, torch.ones(2, count, 1)], -1) * depth[..., None]
    angles = torch.tensor([[0.05, -0.12, 0.08], [-0.1, 0.02, -0.11]])
    return points, Motion(rotation_exponential(angles), torch.tensor([[0.1, -0.05, 0.12], [-0.02, 0.14, -0.06]]))


def test_exact_matches_give_the_exact_motion() -> None:
    points, true = two_scenes()
    target = project(points, true, FOCAL_CELLS)
    found = solve_motion(points, target, torch.ones_like(target), FOCAL_CELLS, Motion.none(points[:, 0]), iterations=6)
    torch.testing.assert_close(found.motion.rotation, true.rotation, atol=2e-4, rtol=0)
    torch.testing.assert_close(found.motion.translation, true.translation, atol=5e-4, rtol=0)


def test_matches_without_weight_change_nothing_however_wrong() -> None:
    points, true = two_scenes()
    target = project(points, true, FOCAL_CELLS)
    weights = torch.ones_like(target)
    spoilt = target.clone()
    spoilt[:, ::3] += 15.0
    weights[:, ::3] = 0
    found = solve_motion(points, spoilt, weights, FOCAL_CELLS, Motion.none(points[:, 0]), iterations=6)
    torch.testing.assert_close(found.motion.translation, true.translation, atol=1e-3, rtol=0)


def test_no_trust_at_all_means_no_motion() -> None:
    points, true = two_scenes()
    target = project(points, true, FOCAL_CELLS)
    found = solve_motion(points, target, torch.zeros_like(target), FOCAL_CELLS, Motion.none(points[:, 0]))
    torch.testing.assert_close(found.motion.rotation, torch.eye(3).expand(2, 3, 3), atol=1e-4, rtol=0)
    torch.testing.assert_close(found.motion.translation, torch.zeros(2, 3), atol=1e-7, rtol=0)


def test_noisy_matches_carry_less_information() -> None:
    points, true = two_scenes()
    target = project(points, true, FOCAL_CELLS)
    noise = torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
    weights, start = torch.ones_like(target), Motion.none(points[:, 0])
    clean = solve_motion(points, target, weights, FOCAL_CELLS, start, iterations=5).information
    noisy = solve_motion(points, target + noise, weights, FOCAL_CELLS, start, iterations=5).information
    # Unit noise on both coordinates has variance 1 against a floor of 0.02: about 50 times less.
    ratio = clean.diagonal(dim1=1, dim2=2) / noisy.diagonal(dim1=1, dim2=2)
    assert bool(((ratio > 25) & (ratio < 100)).all())


def test_a_held_back_motion_is_the_ridge_regression_of_its_flow() -> None:
    points, true = two_scenes()
    points = points.double()
    focal, tiny = FOCAL_CELLS.double(), 1e-4
    angles, translation = tiny * rotation_logarithm(true.rotation.double()), tiny * true.translation.double()
    target = project(points, Motion(rotation_exponential(angles), translation), focal)
    flow = target - focal[:, None, None] * points[..., :2] / points[..., 2:]
    noise = 0.3 * float(flow.square().mean())  # the smallest flow, 1e-4 cells^2, is far above the flow itself
    found = solve_motion(
        points, target, torch.ones_like(target), focal, Motion.none(points[:, 0]), iterations=30, flow_noise=noise
    )
    x, y, z = points.unbind(-1)
    zero = torch.zeros_like(x)
    across = torch.stack([1 / z, zero, -x / z**2, -x * y / z**2, 1 + (x / z) ** 2, -y / z], -1)
    down = torch.stack([zero, 1 / z, -y / z**2, -1 - (y / z) ** 2, x * y / z**2, x / z], -1)
    jacobian = focal[:, None, None, None] * torch.stack([across, down], 2)
    for pair in range(2):
        design, seen = jacobian[pair].flatten(0, 1), flow[pair].flatten()
        hold = noise / (float(flow[pair].square().mean()) + 1e-4)
        normal = design.T @ design
        expected = torch.linalg.solve(normal + hold * torch.diag(normal.diagonal()), design.T @ seen)
        observed = torch.cat([found.motion.translation[pair], rotation_logarithm(found.motion.rotation[pair])])
        torch.testing.assert_close(observed, expected, rtol=2e-2, atol=1e-9)


def test_noise_turns_a_still_camera_that_is_held_back_less_and_a_moving_one_as_before() -> None:
    random = torch.Generator().manual_seed(5)
    plane = torch.rand(1, 250, 2, generator=random) * 0.7 - 0.35
    wall = torch.cat([plane, torch.ones(1, 250, 1)], -1) * (1 + 0.04 * torch.rand(1, 250, 1, generator=random))
    points, focal = wall.expand(20, -1, -1), torch.full((20,), 40.0)
    noise = 0.2 * torch.randn(20, 250, 2, generator=random)

    def turned(shift: float, flow_noise: float) -> float:
        true = Motion(torch.eye(3).expand(20, 3, 3), shift * torch.tensor([0.04, -0.02, 0.01]).expand(20, 3))
        seen = project(points, true, focal) + noise
        start = Motion.none(points[:, 0])
        found = solve_motion(points, seen, torch.ones_like(seen), focal, start, iterations=8, flow_noise=flow_noise)
        return float(rotation_logarithm(found.motion.rotation).norm(dim=-1).mean())

    assert turned(0.0, 0.001) < 0.3 * turned(0.0, 0.0)
    assert turned(0.1, 0.001) < 0.5 * turned(0.1, 0.0)
    assert turned(1.0, 0.001) < 1.15 * turned(1.0, 0.0)
    assert turned(3.0, 0.001) < 1.05 * turned(3.0, 0.0)


def test_the_solver_passes_a_correct_gradient_to_matches_and_weights() -> None:
    points, true = two_scenes(12)
    points, focal = points.double(), FOCAL_CELLS.double()
    exact = project(points, Motion(true.rotation.double(), true.translation.double()), focal)
    target = (exact + 0.1 * torch.sin(torch.arange(exact.numel()).double()).reshape(exact.shape)).requires_grad_()
    weights = torch.full_like(exact, 0.6).requires_grad_()

    def translation(target: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return solve_motion(points, target, weights, focal, Motion.none(points[:, 0]), iterations=2).motion.translation

    assert torch.autograd.gradcheck(translation, (target, weights), atol=1e-6)


def test_elimination_agrees_with_the_library() -> None:
    random = torch.Generator().manual_seed(1)
    root = torch.randn(5, 6, 6, generator=random, dtype=torch.float64)
    matrix, vector = root @ root.transpose(1, 2) + 0.1 * torch.eye(6), torch.randn(5, 6, generator=random).double()
    torch.testing.assert_close(solve_positive(matrix, vector), torch.linalg.solve(matrix, vector))


@pytest.mark.parametrize("angle", [1e-5, 0.3, 2.5], ids=["tiny", "small", "large"])
def test_exponential_and_logarithm_agree_with_scipy(angle: float) -> None:
    vector = angle * np.array([[0.6, -0.64, 0.48]])
    rotation = rotation_exponential(torch.from_numpy(vector))
    np.testing.assert_allclose(rotation.numpy(), Rotation.from_rotvec(vector).as_matrix(), atol=1e-7)
    np.testing.assert_allclose(rotation_logarithm(rotation).numpy(), vector, atol=2e-5)


def test_the_adjoint_moves_a_small_motion_across_another() -> None:
    turn, shift = rotation_exponential(torch.tensor([0.4, -0.2, 0.7]).double()), torch.tensor([0.3, 1.0, -0.5]).double()
    small = 1e-4 * torch.tensor([0.5, -1.0, 0.3, 0.2, 0.9, -0.4]).double()
    before = compose((turn, shift), (rotation_exponential(small[3:]), small[:3]))
    carried = adjoint(turn, shift) @ small
    after = compose((rotation_exponential(carried[3:]), carried[:3]), (turn, shift))
    torch.testing.assert_close(before[1], after[1], atol=1e-7, rtol=0)
    torch.testing.assert_close(before[0], after[0], atol=1e-7, rtol=0)


def test_relative_motion_carries_points_between_cameras() -> None:
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, :3] = rotation_exponential(torch.tensor([0.2, 0.3, -0.1]))
    poses[1, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    rotation, translation = relative_motion(poses, torch.tensor([0]), torch.tensor([1]))
    point = torch.tensor([0.5, -0.4, 2.0, 1.0])
    expected = (torch.linalg.inv(poses[1]) @ poses[0] @ point)[:3]
    torch.testing.assert_close(rotation[0] @ point[:3] + translation[0], expected)

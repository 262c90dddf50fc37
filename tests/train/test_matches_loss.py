"""The matches term: smallest for true depth, blind to scale, exact although the motion has no gradient."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from consistency_runs import SIZE, run_settings, uneven_network
from torch import Tensor

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.clip_step import ClipStep
from bathyscope_train.consistency.geometry import encode
from bathyscope_train.losses.matches import matches_loss
from bathyscope_train.model.matching_camera_head import PlacedMatches
from bathyscope_train.model.pose_layer import Motion, project, rays, solve_motion
from bathyscope_train.model.rigid import rotation_exponential
from bathyscope_train.render import CpuRenderer

FOCAL = torch.tensor([24.0], dtype=torch.float64)


def scene() -> tuple[Tensor, Tensor, Tensor]:
    """Rays (1, q, 3), their true depths (1, q), and where they are seen after a motion."""
    random = torch.Generator().manual_seed(4)
    cells = (torch.rand(1, 150, 2, generator=random, dtype=torch.float64) - 0.5) * torch.tensor([34.0, 27.0])
    depth = 0.6 + torch.rand(1, 150, generator=random, dtype=torch.float64)
    turn = rotation_exponential(torch.tensor([[0.05, -0.04, 0.02]], dtype=torch.float64))
    motion = Motion(turn, torch.tensor([[0.12, 0.02, 0.1]], dtype=torch.float64))
    directions = rays(cells, FOCAL[:, None].expand(depth.shape))
    return directions, depth, project(directions * depth[..., None], motion, FOCAL)


def loss(depth: Tensor, *, detached: bool = True) -> Tensor:
    """The term at some depth, with the motion that fits best there."""
    directions, _, matches = scene()
    points, trust = directions * depth[..., None], torch.ones_like(matches)
    start = Motion.none(torch.zeros(1, 3, dtype=torch.float64))
    motion = solve_motion(points, matches, trust, FOCAL, start, iterations=20).motion
    motion = motion.detach() if detached else motion
    return matches_loss(PlacedMatches(points, matches, trust, FOCAL, motion), delta=10.0)


def test_the_truth_costs_nothing_and_every_wrong_depth_does() -> None:
    _, depth, _ = scene()
    assert float(loss(depth)) < 1e-5
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    wrong = {
        "constant": torch.full_like(depth, 1.0),
        "flattened": depth**0.7,
        "deepened": depth**1.3,
        "noisy": depth * (0.1 * noise).exp(),
    }
    for name, each in wrong.items():
        assert float(loss(each)) > 1e-3, name


def test_scene_and_motion_that_shrink_together_cost_the_same() -> None:
    directions, depth, matches = scene()
    motion = Motion(torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.1, 0.0, 0.05]], dtype=torch.float64))
    trust = torch.ones_like(matches)
    seen = PlacedMatches(directions * depth[..., None], matches, trust, FOCAL, motion)
    half = replace(seen, points=0.5 * seen.points, motion=Motion(motion.rotation, 0.5 * motion.translation))
    torch.testing.assert_close(matches_loss(half), matches_loss(seen))


def test_the_gradient_with_the_motion_held_is_that_of_solving_it_anew() -> None:
    _, depth, _ = scene()
    gradients = []
    for detached in (True, False):
        guess = (depth**0.8).requires_grad_()
        (found,) = torch.autograd.grad(loss(guess, detached=detached), guess)
        gradients.append(found)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=5e-3 * float(gradients[1].abs().max()))


def test_a_point_without_trust_and_a_point_far_off_do_not_rule() -> None:
    directions, depth, matches = scene()
    seen = PlacedMatches(
        directions * depth[..., None],
        matches.clone(),
        torch.ones_like(matches),
        FOCAL,
        solve_motion(
            directions * depth[..., None],
            matches,
            torch.ones_like(matches),
            FOCAL,
            Motion.none(torch.zeros(1, 3, dtype=torch.float64)),
        ).motion,
    )
    seen.matches[0, 0] += 7.0
    assert float(matches_loss(seen, delta=0.5)) == pytest.approx(0.5 * (7 - 0.25) / 150, rel=1e-2)  # Huber by hand
    seen.trust[0, 0] = 0
    assert float(matches_loss(seen, delta=0.5)) < 1e-4


def test_cameras_taken_as_given_are_the_same_cameras_and_leave_the_solver_alone() -> None:
    network = uneven_network()
    images = torch.rand(1, 4, 3, *SIZE, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        refiner = network.camera_head.refiner
        for value in refiner.parameters():
            value.add_(0.05 * torch.randn_like(value))
    features = encode(network, images, trained=False)
    depth = network.dense(features, images).depth
    plain, given = network.cameras(features, depth), network.cameras(features, depth, given=True)
    torch.testing.assert_close(given.pose_encodings, plain.pose_encodings)
    torch.testing.assert_close(given.depth, plain.depth)
    assert not given.pose_encodings.requires_grad
    assert given.seen is not None
    (given.depth.mean() + matches_loss(given.seen)).backward()
    moved = {name for name, value in network.camera_head.named_parameters() if value.grad is not None}
    assert moved == {f"refiner.{name}" for name, _ in refiner.named_parameters()}
    assert any(value.grad is not None for value in network.depth_head.parameters())


def test_matches_of_cameras_that_are_not_given_are_refused(tmp_path: Path) -> None:
    settings = run_settings(tmp_path, tmp_path, tmp_path, cameras="before")
    asked = settings.loss.model_copy(update={"matches": settings.loss.matches.model_copy(update={"weight": 1.0})})
    with pytest.raises(SettingsError, match=r"cameras is 'before'; set loss\.matches\.weight=0"):
        ClipStep(uneven_network(), settings.model_copy(update={"loss": asked}), CpuRenderer())

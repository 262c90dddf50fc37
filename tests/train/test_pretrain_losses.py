"""Supervised losses against closed forms."""

import math

import pytest
import torch

from bathyscope_train.losses.depth import CONFIDENCE_PRIOR, confidence_loss, gradient_loss, log_depth_loss
from bathyscope_train.losses.gaussian_targets import (
    ERROR_SCALE,
    OPAQUE,
    depth_edges,
    depth_error,
    gaussian_loss,
    opacity_target,
    predicted_shape,
    surface_shape,
)
from bathyscope_train.model.gaussian_parameters import footprint_gaussians


def ramp(height: int = 10, width: int = 12) -> torch.Tensor:
    """Depth from 1 to 2, (1, 1, h, w)."""
    return (1 + torch.arange(width) / (width - 1)).expand(1, 1, height, width)


def everywhere(depth: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(depth, dtype=torch.bool)


def test_twice_the_depth_costs_log_two_and_no_gradient() -> None:
    true = ramp()
    assert log_depth_loss(2 * true, true, everywhere(true)).item() == pytest.approx(math.log(2), abs=1e-6)
    assert gradient_loss(2 * true, true, everywhere(true)).item() == pytest.approx(0, abs=1e-6)


def test_pixels_without_truth_cost_nothing() -> None:
    true = ramp().clone()
    valid = everywhere(true)
    valid[..., :6] = False
    true[..., :6] = 0
    predicted = true + 5.0 * ~valid
    assert log_depth_loss(predicted, true, valid).item() == pytest.approx(0, abs=1e-6)
    assert gradient_loss(predicted, true, valid).item() == pytest.approx(0, abs=1e-6)


def test_a_tilted_error_costs_its_slope_over_both_gaps() -> None:
    true = torch.ones(1, 1, 8, 12)
    predicted = torch.exp(0.01 * torch.arange(12.0)).expand(1, 1, 8, 12)
    # Across: 0.01 over one pixel and 0.04 over four; down: nothing; the two directions are averaged.
    expected = (0.01 + 0.04) / 2
    assert gradient_loss(predicted, true, everywhere(true)).item() == pytest.approx(expected, rel=1e-3)


def test_the_best_confidence_is_the_prior_over_the_error() -> None:
    error = torch.full((1, 1, 2, 2), 0.02)
    best = CONFIDENCE_PRIOR / 0.02
    losses = [
        confidence_loss(torch.full_like(error, best * factor), error, everywhere(error)).item()
        for factor in (0.8, 1.0, 1.25)
    ]
    assert losses[1] < min(losses[0], losses[2])


def test_opacity_is_wanted_where_depth_is_right_up_to_scale_and_nowhere_else() -> None:
    true = ramp().clone()
    true[..., -1] = 0
    valid = true > 0
    predicted = 3 * ramp().clone()
    predicted[..., 2, 3] *= math.exp(ERROR_SCALE)
    target = opacity_target(depth_error(predicted, true, valid), depth_edges(true, valid) & False, valid)
    assert target[0, 0, 5, 5].item() == pytest.approx(OPAQUE, rel=1e-5)
    assert target[0, 0, 2, 3].item() == pytest.approx(OPAQUE / 2, rel=1e-3)
    assert not target[..., -1].any()


def test_a_plane_has_no_edges_and_a_step_has_two() -> None:
    inverse = 1 - 0.04 * torch.arange(20.0)
    plane = (1 / inverse).expand(1, 1, 6, 20)
    interior = (..., slice(1, -1), slice(1, -1))
    assert not depth_edges(plane, everywhere(plane))[interior].any()
    step = torch.where(torch.arange(20) < 10, 1.0, 1.5).expand(1, 1, 6, 20)
    edges = depth_edges(step, everywhere(step))[0, 0, 3]
    assert edges.nonzero().flatten().tolist() == [9, 10]


def test_a_wall_seen_head_on_wants_half_a_pixel_along_and_a_fifth_across() -> None:
    shape = surface_shape(torch.ones(1, 1, 9, 9), torch.tensor([1000.0]))
    torch.testing.assert_close(shape[0, 0, 4, 4], torch.diag(torch.tensor([0.5, 0.5, 0.2])), atol=1e-5, rtol=0)


def test_a_wall_at_sixty_degrees_wants_twice_the_length_along_its_slope() -> None:
    focal, size = 1000.0, 9
    x = (torch.arange(size) + 0.5 - size / 2) / focal
    depth = (1 / (1 - math.tan(math.radians(60)) * x)).expand(1, 1, size, size)
    shape = surface_shape(depth, torch.tensor([focal]))[0, 0, 4, 4]
    along = torch.tensor([math.cos(math.radians(60)), 0.0, math.sin(math.radians(60))])
    torch.testing.assert_close(shape @ along, 1.0 * along, atol=5e-3, rtol=0)
    assert torch.linalg.eigvalsh(shape).tolist() == pytest.approx([0.2, 0.5, 1.0], abs=5e-3)


def test_the_supervised_shape_is_the_one_that_the_scene_is_made_of() -> None:
    raw = torch.randn(1, 1, 12, 2, 3, generator=torch.Generator().manual_seed(0))
    shape = predicted_shape(raw)[0, 0].reshape(6, 3, 3)
    flat = raw[0, 0].permute(1, 2, 0).reshape(1, 1, 6, 12)[..., :-1]
    scene = footprint_gaussians(
        torch.zeros(1, 1, 6, 3),
        flat,
        footprint=torch.ones(1, 1, 6),
        colours=torch.zeros(1, 1, 6, 3),
        rotation=torch.eye(3)[None, None],
    )
    w, x, y, z = scene.rotations[0].unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = torch.stack([torch.stack(row, -1) for row in rows], -2)
    expected = rotation @ torch.diag_embed(scene.scales[0]) @ rotation.transpose(1, 2)
    torch.testing.assert_close(shape, expected, atol=1e-5, rtol=1e-5)


def test_the_gaussian_loss_falls_to_its_floor_at_the_wanted_values() -> None:
    true = torch.ones(1, 1, 12, 12)
    raw = torch.zeros(1, 1, 12, 12, 12)
    focal = torch.tensor([1000.0])
    before = gaussian_loss(raw, true, true, everywhere(true), focal)
    raw[:, :, 0] = math.log(OPAQUE / (1 - OPAQUE))
    raw[:, :, 1:3] = math.log(math.expm1(0.5))
    raw[:, :, 3] = math.log(math.expm1(0.2))
    raw[:, :, -1] = -math.log(0.02)
    after = gaussian_loss(raw, true, true, everywhere(true), focal)
    entropy = -(OPAQUE * math.log(OPAQUE) + (1 - OPAQUE) * math.log(1 - OPAQUE))
    assert after.item() == pytest.approx(5 * entropy, abs=5e-3)
    assert before > after + 0.5

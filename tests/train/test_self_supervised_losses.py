"""The losses of EndoDAC and EndoDAV on pictures and scenes worked out by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.losses.corner_warping import reproject, warp_by_depth, warp_by_flow
from bathyscope_train.losses.endodac import SourceView, depth_objective, flow_objective, refined_target
from bathyscope_train.losses.endodav import depth_flow_loss, depth_reprojection_loss
from bathyscope_train.losses.occlusion import splat_ones, visibility_mask
from bathyscope_train.losses.resemblance import masked_average, photometric_error
from bathyscope_train.losses.smoothness import appearance_smoothness, disparity_smoothness, edge_aware_smoothness

SIZE = (12, 16)
K = torch.tensor([[[20.0, 0.0, 7.5], [0.0, 20.0, 5.5], [0.0, 0.0, 1.0]]])


def picture(seed: int = 0, frames: int = 1) -> Tensor:
    return torch.rand(frames, 3, *SIZE, generator=torch.Generator().manual_seed(seed))


def shift(dx: float = 0.0, dy: float = 0.0, dz: float = 0.0) -> Tensor:
    matrix = torch.eye(4)[None].clone()
    matrix[0, :3, 3] = torch.tensor((dx, dy, dz))
    return matrix


def flow_of(dy: float, dx: float) -> Tensor:
    return torch.stack((torch.full(SIZE, dy), torch.full(SIZE, dx)))[None]


def test_a_picture_does_not_differ_from_itself() -> None:
    assert photometric_error(picture(), picture()).abs().max() < 1e-6


def test_flat_pictures_differ_by_their_luminance_and_their_colour() -> None:
    dark, bright = torch.full((1, 3, *SIZE), 0.2), torch.full((1, 3, *SIZE), 0.6)
    luminance = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    expected = 0.85 * (1 - luminance) / 2 + 0.15 * 0.4
    torch.testing.assert_close(photometric_error(dark, bright), torch.full((1, 1, *SIZE), expected), atol=1e-4, rtol=0)


def test_an_average_over_an_empty_mask_is_zero_with_a_gradient() -> None:
    values = picture().requires_grad_()
    masked_average(values, torch.zeros(1, 1, *SIZE)).backward()
    assert values.grad is not None
    assert torch.equal(values.grad, torch.zeros_like(values))


def test_flow_is_down_then_right_and_repeats_the_border() -> None:
    image = picture()
    warped = warp_by_flow(image, flow_of(2.0, 3.0))
    torch.testing.assert_close(warped[..., :-2, :-3], image[..., 2:, 3:], atol=1e-5, rtol=0)
    torch.testing.assert_close(warped[..., -1, -1], image[..., -1, -1], atol=1e-5, rtol=0)


def test_a_camera_that_moves_sideways_shifts_a_plane_by_focal_length_over_depth() -> None:
    depth = torch.full((1, *SIZE), 5.0)
    pixels, moved = reproject(depth, shift(dx=0.5, dz=0.0), K)
    columns = torch.arange(SIZE[1], dtype=torch.float32).expand(SIZE)
    torch.testing.assert_close(pixels[0, ..., 0], columns + 20 * 0.5 / 5, atol=1e-4, rtol=0)
    torch.testing.assert_close(moved, depth)
    warped = warp_by_depth(picture(), depth, shift(dx=0.5), K)
    torch.testing.assert_close(warped[..., :-2], picture()[..., 2:], atol=1e-4, rtol=0)


def test_what_flows_from_elsewhere_leaves_its_place_unseen() -> None:
    arrived = splat_ones(flow_of(0.0, 2.0))[0, 0]
    assert torch.equal(arrived[:, :2], torch.zeros(SIZE[0], 2))
    assert torch.equal(arrived[:, 2:], torch.ones(SIZE[0], SIZE[1] - 2))
    mask = visibility_mask(flow_of(0.0, 2.0))
    assert torch.equal(mask[0, 0], (arrived > 0.95).float())


def test_half_a_pixel_of_flow_is_split_and_lost_at_the_border() -> None:
    arrived = splat_ones(flow_of(0.5, 0.0))[0, 0]
    torch.testing.assert_close(arrived[0], torch.full((SIZE[1],), 0.5))
    torch.testing.assert_close(arrived[1:], torch.ones(SIZE[0] - 1, SIZE[1]))


def test_a_ramp_costs_its_slope_and_an_edge_in_the_picture_forgives_it() -> None:
    ramp = torch.arange(SIZE[1], dtype=torch.float32).expand(1, 1, *SIZE)
    torch.testing.assert_close(edge_aware_smoothness(ramp, torch.zeros(1, 3, *SIZE)), torch.tensor(1.0))
    picture_ramp = ramp.expand(1, 3, *SIZE) * 0.5
    expected = torch.exp(torch.tensor(-0.5))
    torch.testing.assert_close(edge_aware_smoothness(ramp, picture_ramp), expected)


def test_scaling_a_disparity_does_not_change_its_smoothness() -> None:
    disparity = picture()[:, :1] + 0.1
    one, ten = (disparity_smoothness(scale * disparity, picture(1)) for scale in (1.0, 10.0))
    torch.testing.assert_close(one, ten, atol=1e-5, rtol=1e-5)


def test_appearance_is_smooth_only_inside_the_mask() -> None:
    change = torch.zeros(1, 3, *SIZE)
    change[..., 8:] = 1.0
    mask = torch.ones(1, 1, *SIZE)
    flat = torch.zeros(1, 3, *SIZE)
    torch.testing.assert_close(appearance_smoothness(change, flat, mask), torch.tensor(1 / 15))
    mask[..., 7] = 0
    assert appearance_smoothness(change, flat, mask) == 0


def view(target: Tensor, *, appearance: Tensor | None = None) -> SourceView:
    """A source that both warps bring onto the target exactly."""
    change = torch.zeros_like(target) if appearance is None else appearance
    return SourceView(target, flow_of(0.0, 0.0), torch.ones(1, 1, *SIZE), change)


def test_what_is_explained_completely_costs_nothing() -> None:
    target, flat = picture(), torch.full((1, 1, *SIZE), 0.3)
    assert flow_objective(target, [view(target), view(target)], scale=0).abs() < 1e-6
    assert depth_objective(target, flat, [view(target)], [target], scale=0).abs() < 1e-6


def test_terms_of_the_depth_objective_have_their_weights() -> None:
    """A constant change of colour: every term in closed form but the picture comparison, which is measured apart."""
    target = torch.full((1, 3, *SIZE), 0.4)
    brighter = view(target, appearance=torch.full_like(target, 0.2))
    ramp = 1 + torch.arange(SIZE[1], dtype=torch.float32).expand(1, 1, *SIZE)
    match = photometric_error(target, refined_target(target, brighter)).mean()
    expected = match + 0.01 * 0.2 + 1e-3 / 4 * (1 / ramp.mean())
    torch.testing.assert_close(depth_objective(target, ramp, [brighter], [target], scale=2), expected)


def test_the_flow_objective_trains_the_flow_alone() -> None:
    source, change = picture(1).requires_grad_(), torch.zeros(1, 3, *SIZE, requires_grad=True)
    seen = SourceView(source, flow_of(0.0, 0.0), torch.ones(1, 1, *SIZE), change)
    flow_objective(picture(), [seen], scale=0).backward()
    assert source.grad is not None
    assert change.grad is None


@pytest.mark.parametrize("objective", ["flow", "depth"])
def test_an_objective_without_sources_is_refused(objective: str) -> None:
    losses = {
        "flow": lambda: flow_objective(picture(), [], scale=0),
        "depth": lambda: depth_objective(picture(), picture()[:, :1], [], [], scale=0),
    }
    with pytest.raises(GeometryError, match="got none; give the frames beside it"):
        losses[objective]()


def approaching_plane(step: float = 0.5, frames: int = 4) -> tuple[Tensor, Tensor]:
    """A camera that moves towards a plane: depth of every frame, and motions from each frame to the next."""
    depth = torch.stack([torch.full(SIZE, 8.0 - step * frame) for frame in range(frames)])[None]
    return depth, shift(dz=-step).expand(frames - 1, 4, 4)[None]


def test_depth_that_agrees_with_the_motion_costs_nothing() -> None:
    """Sideways by one pixel a frame; what leaves the picture drops out."""
    depth, motions = torch.full((1, 4, *SIZE), 5.0), shift(dx=5.0 / 20).expand(3, 4, 4)[None]
    assert depth_reprojection_loss(depth, motions, K) < 1e-4
    slanted = depth + 0.1 * torch.arange(SIZE[0], dtype=torch.float32)[:, None]
    assert depth_reprojection_loss(slanted, shift(dy=5.0 / 20).expand(3, 4, 4)[None], K) > 0.05


def test_a_motion_that_is_missed_costs_its_length() -> None:
    depth, motions = approaching_plane(step=0.5)
    still = torch.eye(4).expand_as(motions)
    torch.testing.assert_close(depth_reprojection_loss(depth, still, K), torch.tensor(0.5), atol=1e-5, rtol=0)


def test_flow_compares_depths_without_their_change() -> None:
    depth, _ = approaching_plane(step=0.5)
    none = flow_of(0.0, 0.0).expand(3, 2, *SIZE)[None]
    torch.testing.assert_close(depth_flow_loss(depth, none, none), torch.tensor(0.5))


def test_pairs_must_be_as_many_as_the_clip_has() -> None:
    depth, motions = approaching_plane()
    with pytest.raises(GeometryError, match=r"4 frames have 3 adjacent pairs.*got 2"):
        depth_reprojection_loss(depth, motions[:, :2], K)
    with pytest.raises(GeometryError, match="1 frames have 0 adjacent pairs"):
        depth_reprojection_loss(depth[:, :1], motions[:, :0], K)

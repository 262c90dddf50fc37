"""The three consistency losses in closed form: planes, shifts, scales, masks; and gradients by finite differences."""

from __future__ import annotations

from dataclasses import replace
from math import log

import pytest
import torch
from flat_worlds import FlatClip, plane_clip
from torch import Tensor

from bathyscope.errors import GeometryError, SettingsError
from bathyscope_train.losses.balance import measured_weights
from bathyscope_train.losses.photometric import photometric_loss
from bathyscope_train.losses.temporal import moving_edges_loss, temporal_gradient_loss
from bathyscope_train.losses.warping import project
from bathyscope_train.losses.world import LOST, meeting_pixels, world_consistency_loss
from bathyscope_train.model.unprojection import unproject

STRIDE = 3


def shrunk(clip: FlatClip, factor: float) -> FlatClip:
    poses = clip.world_from_camera.clone()
    poses[..., :3, 3] *= factor
    return replace(clip, depth=factor * clip.depth, world_from_camera=poses)


def bumpy(clip: FlatClip, amount: float = 0.05) -> FlatClip:
    noise = torch.rand(clip.depth.shape, generator=torch.Generator().manual_seed(2), dtype=clip.depth.dtype)
    return replace(clip, depth=clip.depth * (1 + amount * (noise - 0.5)))


def test_project_undoes_unproject() -> None:
    clip = plane_clip()
    points = unproject(clip.depth, clip.intrinsics, clip.world_from_camera)
    pixels, depth = project(points, clip.intrinsics, clip.world_from_camera)
    torch.testing.assert_close(depth, clip.depth)
    assert pixels[0, 4, 3, 5].tolist() == pytest.approx([5.5, 3.5])


@pytest.mark.parametrize("scale_free", [True, False])
@pytest.mark.parametrize("both_ways", [True, False])
def test_a_fronto_parallel_plane_that_comes_nearer_costs_nothing(scale_free: bool, both_ways: bool) -> None:
    clip = plane_clip(tilt=(0, 0), turn=0, step=(0.05, 0, 0.2))
    loss = world_consistency_loss(*clip.geometry, stride=STRIDE, scale_free=scale_free, both_ways=both_ways)
    torch.testing.assert_close(loss, loss.new_zeros(()), atol=1e-20, rtol=0)


def test_a_tilted_plane_costs_only_its_interpolation() -> None:
    """Depth of a tilted plane bends between pixels, by about the square of its slope."""
    assert float(world_consistency_loss(*plane_clip().geometry, stride=STRIDE)) < 1e-7


@pytest.mark.parametrize("offset", [0.05, 0.5], ids=["quadratic", "linear"])
def test_a_shifted_frame_costs_the_huber_of_its_shift(offset: float) -> None:
    """One frame too deep: one pair ends with it, and in one it starts. Between flat maps the shift is all there is."""
    clip = plane_clip(frames=4, tilt=(0, 0), turn=0, step=(0, 0, 0))
    depth = clip.depth.clone()
    depth[:, 3] += offset
    huber = 0.5 * offset**2 if offset < 0.2 else 0.2 * (offset - 0.1)
    loss = world_consistency_loss(depth, *clip.geometry[1:], stride=STRIDE, scale_free=False, delta=0.2)
    assert float(loss) == pytest.approx(huber)


def test_the_relative_residual_is_a_logarithm() -> None:
    clip = plane_clip(frames=4, tilt=(0, 0), turn=0, step=(0, 0, 0))
    depth = clip.depth.clone()
    depth[:, 3] *= 1.05
    expected = 0.5 * log(1.05) ** 2
    assert float(world_consistency_loss(depth, *clip.geometry[1:], stride=3)) == pytest.approx(expected)


def test_pairs_add_up_and_may_be_averaged() -> None:
    clip = bumpy(plane_clip(frames=8))
    total = world_consistency_loss(*clip.geometry, stride=STRIDE)
    mean = world_consistency_loss(*clip.geometry, stride=STRIDE, reduction="mean")
    parts = [world_consistency_loss(*(part[:, [t, t + STRIDE]] for part in clip.geometry), stride=1) for t in range(5)]
    torch.testing.assert_close(total, torch.stack(parts).sum())
    torch.testing.assert_close(mean, total / 5)


def test_a_clip_without_a_pair_is_refused() -> None:
    clip = plane_clip(frames=3)
    with pytest.raises(GeometryError, match="stride 6 needs a clip of at least 7 frames, got 3"):
        world_consistency_loss(*clip.geometry)
    with pytest.raises(GeometryError, match="at least 7"):
        temporal_gradient_loss(clip.depth, clip.valid)


def all_losses(clip: FlatClip) -> dict[str, Tensor]:
    meets = meeting_pixels(*clip.geometry, stride=STRIDE)
    return {
        "world": world_consistency_loss(*clip.geometry, stride=STRIDE),
        "world, fixed": world_consistency_loss(*clip.geometry, stride=STRIDE, meets=meets),
        "world, as written": world_consistency_loss(*clip.geometry, stride=STRIDE, scale_free=False),
        "edges": moving_edges_loss(*clip.geometry, stride=STRIDE, scales=2),
        "edges, fixed": moving_edges_loss(*clip.geometry, stride=STRIDE, scales=2, meets=meets),
        "temporal": temporal_gradient_loss(clip.depth, clip.valid, stride=STRIDE, scales=2),
    }


def test_what_is_not_valid_changes_nothing() -> None:
    """A pixel that does not count may hold anything, and so may its gradient come to nothing."""
    clip = bumpy(plane_clip())
    valid = clip.valid.clone()
    valid[0, 2, 5:9, 6:8] = False
    valid[0, 5, 0, :] = False
    masked = replace(clip, valid=valid)
    wild = clip.depth.clone()
    wild[0, 2, 5:9, 6:8] = torch.nan
    wild[0, 5, 0, :] = 1e9
    expected, found = all_losses(masked), all_losses(replace(masked, depth=wild.requires_grad_()))
    for name, value in expected.items():
        torch.testing.assert_close(found[name].detach(), value, msg=lambda m, n=name: f"{n}: {m}")
    (gradient,) = torch.autograd.grad(torch.stack(list(found.values())).sum(), wild)
    assert gradient.isfinite().all()
    assert not gradient[~valid].any()


def test_a_uniform_shrink_changes_neither_the_losses_nor_their_slope() -> None:
    """All but the two as written, which it lowers."""
    clip = bumpy(plane_clip())
    before, after = all_losses(clip), all_losses(shrunk(clip, 0.5))
    for name in ("world", "world, fixed", "edges", "edges, fixed"):
        torch.testing.assert_close(after[name], before[name], rtol=1e-9, atol=0)
        factor = torch.ones((), dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(all_losses(shrunk(clip, factor))[name], factor)  # type: ignore[arg-type]
        assert abs(float(slope)) < 1e-9, name
    for name in ("world, as written", "temporal"):
        assert float(after[name]) < 0.6 * float(before[name]), name


@pytest.mark.parametrize("name", ["world", "world, fixed", "world, as written", "edges", "edges, fixed", "temporal"])
def test_gradients_are_finite_differences(name: str) -> None:
    clip = bumpy(plane_clip(frames=5), 0.2)
    part = (slice(None), slice(None), slice(3, 11), slice(4, 13))
    intrinsics = clip.intrinsics.clone()
    intrinsics[..., 0, 2] -= 4
    intrinsics[..., 1, 2] -= 3
    meets = torch.rand(1, 5 - STRIDE, 8, 9, generator=torch.Generator().manual_seed(0)) > 0.3

    def value(depth: Tensor, k: Tensor, poses: Tensor) -> Tensor:
        geometry = depth, k, poses, clip.valid[part]
        chosen = {
            "world": lambda: world_consistency_loss(*geometry, stride=STRIDE, delta=0.02),
            "world, fixed": lambda: world_consistency_loss(*geometry, stride=STRIDE, meets=meets),
            "world, as written": lambda: world_consistency_loss(*geometry, stride=STRIDE, scale_free=False),
            "edges": lambda: moving_edges_loss(*geometry, stride=STRIDE, scales=2),
            "edges, fixed": lambda: moving_edges_loss(*geometry, stride=STRIDE, scales=2, meets=meets),
            "temporal": lambda: temporal_gradient_loss(depth, clip.valid[part], stride=STRIDE, scales=2),
        }
        return chosen[name]()

    leaves = [clip.depth[part], intrinsics, clip.world_from_camera]
    ready = [leaf.clone().requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(value, ready, eps=1e-7, atol=1e-5, fast_mode=True)


def test_pushing_pixels_out_of_the_picture_does_not_pay() -> None:
    """Half a frame too near: its pixels move so far that they leave the target, and the mean over the rest is 0."""
    clip = plane_clip(frames=4, tilt=(0, 0), turn=0, step=(-0.15, 0, 0))
    meets = meeting_pixels(*clip.geometry, stride=STRIDE)
    depth = clip.depth.clone()
    depth[:, 0, :, 12:] = 0.5
    kept = (depth, *clip.geometry[1:])
    escaping = world_consistency_loss(*kept, stride=STRIDE)
    held = world_consistency_loss(*kept, stride=STRIDE, meets=meets)
    assert float(escaping) == pytest.approx(0, abs=1e-12)
    assert float(held) > 0.01


def test_opening_a_hole_does_not_pay() -> None:
    """No depth where there was some: each pixel of a fixed set costs the Huber of a whole unit, or the whole share."""
    clip = bumpy(plane_clip(frames=4))
    meets = meeting_pixels(*clip.geometry, stride=STRIDE)
    holes = replace(clip, depth=torch.zeros_like(clip.depth))
    loss = world_consistency_loss(*holes.geometry, stride=STRIDE, delta=0.1, meets=meets)
    assert float(loss) == pytest.approx(0.1 * (LOST - 0.05))
    assert float(moving_edges_loss(*holes.geometry, stride=STRIDE, scales=2, meets=meets)) == pytest.approx(1)


def test_a_point_that_falls_behind_the_camera_is_pulled_back() -> None:
    clip = plane_clip(frames=4, tilt=(0, 0), turn=0, step=(0, 0, 0.4))
    meets = meeting_pixels(*clip.geometry, stride=STRIDE)
    depth = torch.full_like(clip.depth, 0.6).requires_grad_()
    loss = world_consistency_loss(depth, *clip.geometry[1:], stride=STRIDE, meets=meets)
    (gradient,) = torch.autograd.grad(loss, depth)
    assert gradient[:, 0].sum() < 0
    assert gradient.isfinite().all()


def test_the_gradient_loss_of_a_steeper_ramp() -> None:
    """Slopes 1 and 3 along x: 2 at scale 0, and twice that at the next, where pixels are twice as wide."""
    ramp = torch.arange(12.0).expand(1, 1, 8, 12)
    depth = torch.cat([1 + ramp, 1 + 3 * ramp], 1)
    valid = torch.ones(depth.shape, dtype=torch.bool)
    assert float(temporal_gradient_loss(depth, valid, stride=1, scales=1)) == pytest.approx(2)
    assert float(temporal_gradient_loss(depth, valid, stride=1, scales=2)) == pytest.approx(6)
    summed = temporal_gradient_loss(depth, valid, stride=1, scales=2, reduction="sum")
    assert float(summed) == pytest.approx(2 * 8 * 11 + 4 * 4 * 5)


def test_the_literal_form_is_least_for_a_constant_map_and_the_compensated_one_is_most() -> None:
    clip = plane_clip(tilt=(0.5, 0.2), turn=0.05)
    flat = replace(clip, depth=torch.full_like(clip.depth, 3))
    assert float(temporal_gradient_loss(flat.depth, flat.valid, stride=STRIDE)) == 0
    assert float(temporal_gradient_loss(clip.depth, clip.valid, stride=STRIDE)) > 0.01
    assert float(moving_edges_loss(*clip.geometry, stride=STRIDE, scales=2)) < 0.02
    still = replace(flat, world_from_camera=torch.eye(4, dtype=torch.float64).expand(1, 8, 4, 4))
    assert float(moving_edges_loss(*still.geometry, stride=STRIDE, scales=2)) == pytest.approx(1)


def test_edges_that_flicker_cost() -> None:
    clip = plane_clip(tilt=(0.5, 0.2))
    shape = torch.rand(clip.depth.shape[-2:], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    waver = torch.tensor([0.0, 0, 0, 1, 1, 1, 0, 0], dtype=torch.float64)[None, :, None, None]
    wavering = replace(clip, depth=clip.depth * (1 + 0.05 * waver * shape))
    calm = moving_edges_loss(*clip.geometry, stride=STRIDE, scales=2)
    assert float(moving_edges_loss(*wavering.geometry, stride=STRIDE, scales=2)) > float(calm) + 0.1


def pictures(frames: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(0)
    image, truth = torch.rand(2, 2, frames, 3, 6, 7, generator=random, dtype=torch.float64)
    return image, truth, torch.rand(2, frames, 6, 7, generator=random) > 0.2


def test_the_photometric_loss_is_the_mean_over_pixels_summed_over_frames() -> None:
    image = torch.full((1, 4, 3, 5, 5), 0.75)
    frames = torch.full_like(image, 0.5)
    valid = torch.ones(1, 4, 5, 5, dtype=torch.bool)
    assert float(photometric_loss(image, frames, valid)) == pytest.approx(4 * 0.25)
    assert float(photometric_loss(image, frames, valid, reduction="mean")) == pytest.approx(0.25)
    assert float(photometric_loss(frames, frames, valid)) == 0


def test_masked_pixels_do_not_count_in_the_photometric_loss() -> None:
    image, frames, valid = pictures()
    expected = photometric_loss(image, frames, valid)
    image[~valid[:, :, None].expand_as(image)] = torch.nan
    torch.testing.assert_close(photometric_loss(image, frames, valid), expected)
    assert float(photometric_loss(image, frames, torch.zeros_like(valid))) == 0


def test_opacity_is_divided_out_but_a_hole_costs_its_brightness() -> None:
    frames = torch.full((1, 1, 3, 2, 2), 0.6)
    opacity = torch.tensor([[[[1.0, 0.5], [0.2, 0.0]]]])
    valid = torch.ones(1, 1, 2, 2, dtype=torch.bool)
    perfect = frames * opacity[:, :, None]
    assert float(photometric_loss(perfect, frames, valid, opacity=opacity)) == pytest.approx(0.6 / 4)


def test_photometric_gradients_are_finite_differences() -> None:
    image, frames, valid = pictures(2)
    opacity = torch.rand(2, 2, 6, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1

    def value(rendered: Tensor, alpha: Tensor) -> Tensor:
        return photometric_loss(rendered, frames, valid, opacity=alpha)

    assert torch.autograd.gradcheck(value, [image.requires_grad_(), opacity.requires_grad_()])


def test_measured_weights_give_every_term_its_share() -> None:
    sizes = {"rgb": 0.05, "world": 0.002, "edges": 0.4}
    weights = measured_weights(sizes, {"rgb": 1.0, "world": 1.0, "edges": 0.5})
    assert weights["rgb"] == 1
    assert weights["world"] * sizes["world"] == pytest.approx(0.05)
    assert weights["edges"] * sizes["edges"] == pytest.approx(0.025)
    assert measured_weights(sizes, {"rgb": 1.0, "edges": 0.0})["edges"] == 0


def test_a_term_that_was_never_measured_cannot_be_balanced() -> None:
    with pytest.raises(SettingsError, match="world"):
        measured_weights({"rgb": 0.1, "world": 0.0}, {"rgb": 1.0, "world": 1.0})

"""Pixels that count: painted pictures with a border, a burnt-out patch and a highlight; and scenes without borders."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.losses.valid import highlights, photometric_pixels, solid_pixels
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import ReferenceRenderer, inside_only, leave_one_out

TISSUE = (0.7, 0.35, 0.3)


def tissue(height: int = 60, width: int = 80) -> tuple[Tensor, Tensor]:
    """Two frames of pink tissue that darkens to the right, and a field of view without 6 columns at the left."""
    shade = torch.linspace(1, 0.4, width)
    frames = (torch.tensor(TISSUE)[:, None, None] * shade).expand(1, 2, 3, height, width).clone()
    inside = torch.ones(1, height, width, dtype=torch.bool)
    inside[..., :6] = False
    frames[..., :6] = 0
    return frames, inside


def test_shaded_tissue_counts_wholly_and_the_border_never() -> None:
    frames, inside = tissue()
    valid = photometric_pixels(frames, inside)
    assert torch.equal(valid, inside[:, None].expand_as(valid))


def test_a_highlight_and_its_rim_do_not_count() -> None:
    frames, inside = tissue()
    frames[0, 0, :, 20:24, 40:45] = torch.tensor([0.95, 0.9, 0.88])[:, None, None]
    valid = photometric_pixels(frames, inside)
    assert not valid[0, 0, 19:25, 39:46].any()
    assert valid[0, 0, 17, 37]
    assert valid[0, 1, 20:24, 40:45].all()
    assert int((~valid[0, 0] & inside[0]).sum()) == 6 * 7


def test_burnt_out_pixels_do_not_count() -> None:
    frames, inside = tissue()
    frames[0, 1, :2, 30:40, 50:60] = 1.0
    frames[0, 0, 0, 30:40, 50:60] = 1.0
    valid = photometric_pixels(frames, inside)
    assert not valid[0, 1, 30:40, 50:60].any()
    assert valid[0, 1, 27, 47]
    assert valid[0, 0, 30:40, 50:60].all(), "red alone is clipped"


def test_a_pale_surface_under_even_light_is_no_highlight() -> None:
    frames = torch.full((1, 1, 3, 40, 50), 0.8)
    frames[..., 25:] = 0.6
    assert not highlights(frames, torch.ones(1, 40, 50, dtype=torch.bool)).any()


def test_what_lies_outside_the_field_of_view_does_not_make_the_inside_white() -> None:
    """Next to a black border the surroundings are those inside."""
    frames = torch.full((1, 1, 3, 40, 50), 0.5)
    frames[..., :20] = 0
    inside = torch.ones(1, 40, 50, dtype=torch.bool)
    inside[..., :20] = False
    assert not highlights(frames, inside).any()


def test_holes_are_no_solid_pixels() -> None:
    opacity = torch.tensor([[[[0.0, 0.29], [0.3, 1.0]]]], requires_grad=True)
    inside = torch.tensor([[[True, True], [True, False]]])
    found = solid_pixels(opacity, inside)
    assert found[0, 0].tolist() == [[False, False], [True, False]]
    assert not found.requires_grad


def flat_scene(frames: int = 2, height: int = 6, width: int = 8) -> GaussianBatch:
    """One Gaussian a pixel of a plane at depth 2, the same in every frame but for its red."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    points = torch.stack([(u - width / 2) / 4, (v - height / 2) / 4, torch.full_like(u, 2)], -1).reshape(1, -1, 3)
    count = frames * height * width
    harmonics = torch.zeros(1, count, 1, 3)
    harmonics[..., 0, 0] = torch.arange(frames).repeat_interleave(height * width)
    return GaussianBatch(
        means=points.repeat(1, frames, 1),
        rotations=torch.tensor([1.0, 0, 0, 0]).expand(1, count, 4),
        scales=torch.full((1, count, 3), 0.1),
        opacities=torch.full((1, count), 0.9),
        harmonics=harmonics,
    )


def views(frames: int, height: int = 6, width: int = 8) -> tuple[Tensor, Tensor, tuple[int, int]]:
    k = torch.tensor([[8.0, 0, width / 2], [0, 8, height / 2], [0, 0, 1]])
    return torch.eye(4).repeat(1, frames, 1, 1), k.repeat(1, frames, 1, 1), (height, width)


def test_black_borders_never_become_gaussians() -> None:
    scene = flat_scene()
    scene.opacities.requires_grad_()
    inside = torch.ones(1, 2, 6, 8, dtype=torch.bool)
    inside[..., :3] = False
    kept = inside_only(scene, inside)
    found = ReferenceRenderer()(kept, *views(2))
    assert float(found.opacity.detach()[..., 0].max()) < 1e-3
    assert float(found.opacity.detach()[..., 5].min()) > 0.5
    (gradient,) = torch.autograd.grad(found.opacity.sum(), scene.opacities)
    assert not gradient.unflatten(1, (2, 6, 8))[..., :3].any()


def test_fused_voxels_have_no_border_to_take_away() -> None:
    with pytest.raises(GeometryError, match="96 Gaussians are not one for each of 3 x 48 pixels"):
        inside_only(flat_scene(), torch.ones(1, 3, 6, 8, dtype=torch.bool))


def test_a_frame_left_out_is_painted_by_the_others() -> None:
    """Red is half a harmonic above grey for each frame number: of two frames each shows the other's."""
    scene = flat_scene()
    found = leave_one_out(ReferenceRenderer(), scene, *views(2))
    colour = (found.image / found.opacity[:, :, None])[0, :, 0, 3, 4]
    assert colour.tolist() == pytest.approx([0.5 + 0.28209479, 0.5], abs=1e-4)
    assert found.depth[0, :, 3, 4].tolist() == pytest.approx([2, 2], abs=1e-4)


def test_one_frame_has_no_others() -> None:
    with pytest.raises(GeometryError, match="at least 2 frames"):
        leave_one_out(ReferenceRenderer(), flat_scene(1), *views(1))
    with pytest.raises(GeometryError, match="equal parts"):
        leave_one_out(ReferenceRenderer(), flat_scene(1), *views(5))

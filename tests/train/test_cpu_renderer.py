"""The renderer for processors: images and gradients of the torch reference in double precision, and its own limits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bathyscope.errors import GeometryError, SettingsError
from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import CpuRenderer, ReferenceRenderer, Rendering

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
NAMES = (*FIELDS, "poses", "intrinsics")
Leaves = dict[str, Tensor]


def made(clips: int = 1, count: int = 60, frames: int = 2, degree: int = 1, seed: int = 0) -> Leaves:
    """Gaussians one to three units ahead of cameras that move and turn a little."""
    random = torch.Generator().manual_seed(seed)
    means = torch.rand(clips, count, 3, generator=random) * 2 - 1
    means[..., 2] += 2
    turns = torch.linalg.matrix_exp(
        torch.cross(
            torch.eye(3).expand(clips, frames, 3, 3),
            0.1 * torch.randn(clips, frames, 1, 3, generator=random).expand(-1, -1, 3, -1),
            dim=-1,
        )
    )
    poses = torch.eye(4).repeat(clips, frames, 1, 1)
    poses[..., :3, :3] = turns
    poses[..., :3, 3] = 0.1 * torch.randn(clips, frames, 3, generator=random)
    intrinsics = torch.tensor([[14.0, 0, 9], [0, 13, 5], [0, 0, 1]]).repeat(clips, frames, 1, 1)
    return {
        "means": means,
        "rotations": torch.randn(clips, count, 4, generator=random),
        "scales": 0.02 + 0.2 * torch.rand(clips, count, 3, generator=random),
        "opacities": 0.2 + 0.75 * torch.rand(clips, count, generator=random),
        "harmonics": 0.3 * torch.randn(clips, count, (degree + 1) ** 2, 3, generator=random),
        "poses": poses,
        "intrinsics": intrinsics,
    }


def rendered(
    renderer: CpuRenderer | ReferenceRenderer, leaves: Leaves, size: tuple[int, int]
) -> tuple[Rendering, Leaves]:
    """The views, and gradients of random weights on all that is rendered."""
    ready = {name: leaf.clone().requires_grad_() for name, leaf in leaves.items()}
    scene = GaussianBatch(*(ready[name] for name in FIELDS))
    found = renderer.from_cameras(scene, ready["poses"], ready["intrinsics"], size)
    random = torch.Generator().manual_seed(9)
    solid = found.opacity.detach() > 0.05
    loss = torch.zeros((), dtype=found.image.dtype)
    for plane in (found.image, found.opacity, found.accumulated, found.depth * solid):
        loss = loss + (torch.randn(plane.shape, generator=random).to(plane) * plane).sum()
    loss.backward()
    return found, {name: leaf.grad for name, leaf in ready.items() if leaf.grad is not None}


def assert_like_reference(
    leaves: Leaves,
    settings: SplatSettings | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    size: tuple[int, int] = (11, 18),
) -> None:
    settings = settings or SplatSettings()
    found, gradients = rendered(CpuRenderer(settings, background), leaves, size)
    doubles = {name: leaf.double() for name, leaf in leaves.items()}
    expected, wanted = rendered(ReferenceRenderer(settings, background), doubles, size)
    for name in ("image", "opacity", "accumulated", "depth"):
        torch.testing.assert_close(
            getattr(found, name).double(), getattr(expected, name), rtol=0, atol=3e-5, msg=lambda m, n=name: f"{n}: {m}"
        )
    for name in NAMES:
        error = (gradients[name].double() - wanted[name]).norm()
        assert error <= 2e-4 * wanted[name].norm() + 1e-6, (name, float(error), float(wanted[name].norm()))


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_gradients_are_those_of_the_reference(degree: int) -> None:
    assert_like_reference(made(degree=degree, seed=degree))


@pytest.mark.parametrize(
    "settings",
    [
        SplatSettings(antialiased=True),
        SplatSettings(max_alpha=0.9, transmittance_cutoff=0.05),
        SplatSettings(near_plane=1.8, far_plane=2.6),
        SplatSettings(eps2d=1.5, radius_clip=3),
        SplatSettings(alpha_threshold=0.05),
        SplatSettings(degree=0),
    ],
    ids=["antialiased", "early stop", "planes", "radius clip", "threshold", "lower degree"],
)
def test_settings_mean_what_they_mean_to_the_reference(settings: SplatSettings) -> None:
    assert_like_reference(made(seed=7, degree=2), settings)


def test_a_background_and_a_batch_of_clips() -> None:
    assert_like_reference(made(clips=2, frames=3, count=40), background=(1.0, 0.4, 0.1), size=(9, 16))


@pytest.mark.parametrize("size", [(1, 1), (3, 29), (17, 8)])
def test_images_of_any_size(size: tuple[int, int]) -> None:
    assert_like_reference(made(seed=3), size=size)


def test_slopes_outside_the_image_pass_their_bounds_to_the_intrinsics() -> None:
    """Large Gaussians beside a narrow image, whose centres lie far outside."""
    leaves = made(count=30, seed=4)
    leaves["means"][..., :2] *= 3
    leaves["scales"] = leaves["scales"] * 4
    assert_like_reference(leaves)


def test_what_cannot_be_seen_gets_no_gradient() -> None:
    """Behind the camera, nearer than the near plane, far off the image, transparent, or too faint."""
    leaves = made(count=25, frames=1)
    leaves["poses"] = torch.eye(4)[None, None]
    leaves["means"][0, :5, 2] = -3
    leaves["means"][0, 5:10] = torch.tensor([0.0, 0.0, 0.001])
    leaves["means"][0, 10:15, 0] = 500
    leaves["opacities"][0, 15:18] = 0
    leaves["opacities"][0, 18:20] = 0.9 / 255
    assert_like_reference(leaves)
    _, gradients = rendered(CpuRenderer(), leaves, (11, 18))
    for name in FIELDS:
        assert not gradients[name][0, :20].any(), name
        assert gradients[name][0, 20:].any(), name


def test_opaque_and_needle_shaped_gaussians() -> None:
    leaves = made(count=30, seed=6)
    leaves["opacities"][0, :10] = 1
    leaves["scales"][0, 10:20] = torch.tensor([0.5, 1e-4, 1e-5])
    leaves["rotations"] = leaves["rotations"] * 20
    assert_like_reference(leaves)


def test_a_gaussian_right_before_the_lens_stays_finite() -> None:
    leaves = made(count=3)
    leaves["means"][0] = torch.tensor([[0.0, 0, 2e-4], [1e-4, 0, 1e-3], [0, 0, 1]])
    _, gradients = rendered(CpuRenderer(SplatSettings(near_plane=1e-10)), leaves, (8, 8))
    assert all(gradient.isfinite().all() for gradient in gradients.values())


def test_a_single_gaussian_in_closed_form() -> None:
    """Straight ahead at depth 2: opacity at its centre pixel is o exp(0), so dL/do = 1 and dL/dz of depth is 1."""
    leaves = made(count=1, frames=1)
    leaves |= {
        "means": torch.tensor([[[0.0, 0, 2]]]),
        "opacities": torch.tensor([[0.6]]),
        "poses": torch.eye(4)[None, None],
    }
    leaves["intrinsics"][..., 0, 2], leaves["intrinsics"][..., 1, 2] = 4.5, 3.5
    ready = {name: leaf.clone().requires_grad_() for name, leaf in leaves.items()}
    scene = GaussianBatch(*(ready[name] for name in FIELDS))
    found = CpuRenderer().from_cameras(scene, ready["poses"], ready["intrinsics"], (7, 9))
    assert found.opacity[0, 0, 3, 4].item() == pytest.approx(0.6, abs=1e-6)
    assert found.depth[0, 0, 3, 4].item() == pytest.approx(2, abs=1e-6)
    (found.opacity[0, 0, 3, 4] + found.depth[0, 0, 3, 4]).backward()
    assert ready["opacities"].grad is not None
    assert ready["means"].grad is not None
    assert ready["opacities"].grad.item() == pytest.approx(1, abs=1e-5)
    torch.testing.assert_close(ready["means"].grad[0, 0], torch.tensor([0.0, 0, 1]), atol=1e-5, rtol=0)


def test_an_empty_scene_is_background() -> None:
    leaves = made(count=0)
    found, gradients = rendered(CpuRenderer(background=(0.2, 0.3, 0.4)), leaves, (5, 6))
    assert found.image[0, 0, :, 2, 2].tolist() == pytest.approx([0.2, 0.3, 0.4])
    assert not gradients["poses"].any()


def test_threads_share_the_views_and_repeat_themselves() -> None:
    leaves = made(frames=5, count=80, degree=2)
    one = rendered(CpuRenderer(threads=1), leaves, (11, 18))[1]
    two = [rendered(CpuRenderer(threads=2), leaves, (11, 18))[1] for _ in range(2)]
    for name in NAMES:
        assert torch.equal(two[0][name], two[1][name]), name
        torch.testing.assert_close(two[0][name], one[name], rtol=1e-4, atol=1e-4 * float(one[name].abs().max()))


def test_a_rendering_keeps_its_images_and_nothing_that_grows_with_views_times_gaussians() -> None:
    count, frames, size = 2000, 6, (8, 8)
    leaves = {name: leaf.requires_grad_() for name, leaf in made(count=count, frames=frames).items()}
    inputs = {leaf.untyped_storage().data_ptr() for leaf in leaves.values()}
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in inputs:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        scene = GaussianBatch(*(leaves[name] for name in FIELDS))
        CpuRenderer().from_cameras(scene, leaves["poses"], leaves["intrinsics"], size)
    assert sum(kept.values()) < 20 * 4 * frames * size[0] * size[1] < 4 * count * frames


def test_spare_memory_bounds_the_threads() -> None:
    renderer = CpuRenderer(threads=8, spare_memory=100)
    assert renderer.workers(16, 40) == 3
    assert renderer.workers(2, 40) == 2
    assert renderer.workers(16, 1000) == 1


def test_world_poses_are_inverted() -> None:
    leaves = made()
    scene = GaussianBatch(*(leaves[name] for name in FIELDS))
    world = torch.linalg.inv(leaves["poses"])
    found = CpuRenderer()(scene, world, leaves["intrinsics"], (11, 18))
    expected = CpuRenderer().from_cameras(scene, leaves["poses"], leaves["intrinsics"], (11, 18))
    torch.testing.assert_close(found.image, expected.image, rtol=0, atol=1e-4)


def test_double_precision_is_refused_with_a_way_out() -> None:
    leaves = made()
    scene = GaussianBatch(*(leaves[name].double() for name in FIELDS))
    with pytest.raises(SettingsError, match="reference renderer"):
        CpuRenderer().from_cameras(scene, leaves["poses"], leaves["intrinsics"], (4, 4))


def test_numbers_that_are_not_finite_are_named() -> None:
    leaves = made()
    leaves["harmonics"][0, 3, 0, 0] = torch.nan
    scene = GaussianBatch(*(leaves[name] for name in FIELDS))
    with pytest.raises(GeometryError, match="harmonics"):
        CpuRenderer().from_cameras(scene, leaves["poses"], leaves["intrinsics"], (4, 4))


def test_gradients_that_are_not_finite_stop_the_way_back() -> None:
    leaves = made()
    means = leaves["means"].requires_grad_()
    scene = replace(GaussianBatch(*(leaves[name] for name in FIELDS)), means=means)
    found = CpuRenderer().from_cameras(scene, leaves["poses"], leaves["intrinsics"], (4, 4))
    with pytest.raises(GeometryError, match="not finite"):
        (found.image.sum() * torch.inf).backward()

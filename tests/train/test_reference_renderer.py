"""The torch reference renderer: batches, gradients by finite differences, and the numpy renderer beside it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope.splat import SplatSettings, render
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.render import ReferenceRenderer

SIZE = (9, 12)
FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")


def scenes(clips: int, count: int, dtype: torch.dtype = torch.float64) -> GaussianBatch:
    made = torch.Generator().manual_seed(5)
    means = torch.rand(clips, count, 3, generator=made, dtype=dtype) * 2 - 1
    means[..., 2] += 3
    return GaussianBatch(
        means=means,
        rotations=torch.randn(clips, count, 4, generator=made, dtype=dtype),
        scales=0.1 + 0.3 * torch.rand(clips, count, 3, generator=made, dtype=dtype),
        opacities=0.2 + 0.6 * torch.rand(clips, count, generator=made, dtype=dtype),
        harmonics=0.3 * torch.randn(clips, count, 4, 3, generator=made, dtype=dtype),
    )


def cameras(clips: int, frames: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    poses = torch.eye(4, dtype=dtype).repeat(clips, frames, 1, 1)
    poses[..., 0, 3] = 0.1 * torch.arange(clips * frames, dtype=dtype).reshape(clips, frames)
    intrinsics = torch.tensor([[10.0, 0, 6], [0, 11, 4.5], [0, 0, 1]], dtype=dtype)
    return poses, intrinsics.repeat(clips, frames, 1, 1)


def test_a_batch_is_its_clips_and_frames_one_by_one() -> None:
    scene, (poses, intrinsics) = scenes(2, 30), cameras(2, 3)
    whole = ReferenceRenderer()(scene, poses, intrinsics, SIZE)
    assert whole.image.shape == (2, 3, 3, *SIZE)
    for clip in range(2):
        alone = GaussianBatch(*(getattr(scene, name)[clip : clip + 1] for name in FIELDS))
        for frame in range(3):
            part = (slice(clip, clip + 1), slice(frame, frame + 1))
            single = ReferenceRenderer()(alone, poses[part], intrinsics[part], SIZE)
            torch.testing.assert_close(single.image[0, 0], whole.image[clip, frame])
            torch.testing.assert_close(single.depth[0, 0], whole.depth[clip, frame])


def test_a_world_pose_moves_the_camera_not_the_scene() -> None:
    """A camera half a unit further back sees everything half a unit deeper."""
    scene, (poses, intrinsics) = scenes(1, 20), cameras(1, 1)
    poses[0, 0, 2, 3] = -0.5
    found = ReferenceRenderer()(scene, poses, intrinsics, SIZE)
    moved = GaussianBatch(
        scene.means + scene.means.new_tensor((0, 0, 0.5)),
        scene.rotations,
        scene.scales,
        scene.opacities,
        scene.harmonics,
    )
    expected = ReferenceRenderer()(moved, cameras(1, 1)[0], intrinsics, SIZE)
    torch.testing.assert_close(found.depth, expected.depth)
    torch.testing.assert_close(found.image, expected.image)


@pytest.mark.parametrize("antialiased", [False, True])
def test_it_renders_what_the_numpy_renderer_does(antialiased: bool) -> None:
    scene, (poses, intrinsics) = scenes(1, 60, torch.float32), cameras(1, 1, torch.float32)
    settings = SplatSettings(antialiased=antialiased)
    found = ReferenceRenderer(settings, background=(0.3, 0.2, 0.1))(scene, poses, intrinsics, SIZE)
    expected = render(
        Gaussians(*(getattr(scene, name)[0].numpy() for name in FIELDS)),
        np.eye(4),
        intrinsics[0, 0].numpy(),
        SIZE,
        settings=settings,
        background=np.array([0.3, 0.2, 0.1]),
        backend="numpy",
    )
    assert expected.image is not None
    np.testing.assert_allclose(found.image[0, 0].permute(1, 2, 0), expected.image, atol=1e-5)
    np.testing.assert_allclose(found.depth[0, 0], expected.depth, atol=1e-4)
    np.testing.assert_allclose(found.opacity[0, 0], expected.opacity, atol=1e-5)


def test_the_size_of_a_chunk_changes_nothing() -> None:
    scene, (poses, intrinsics) = scenes(1, 30), cameras(1, 1)
    whole = ReferenceRenderer()(scene, poses, intrinsics, SIZE)
    parts = ReferenceRenderer(chunk=200)(scene, poses, intrinsics, SIZE)
    torch.testing.assert_close(parts.image, whole.image, rtol=0, atol=1e-12)


def test_a_scene_behind_the_camera_is_background_with_gradients_of_zero() -> None:
    scene, (poses, intrinsics) = scenes(1, 10), cameras(1, 1)
    means = (scene.means - 10).requires_grad_()
    behind = GaussianBatch(means, scene.rotations, scene.scales, scene.opacities, scene.harmonics)
    found = ReferenceRenderer(background=(1.0, 0.5, 0.0))(behind, poses, intrinsics, SIZE)
    torch.testing.assert_close(found.image[0, 0, :, 3, 4], torch.tensor([1, 0.5, 0], dtype=torch.float64))
    assert not found.depth.any()
    (found.image.sum() + found.depth.sum()).backward()
    assert means.grad is not None
    assert not means.grad.any()


def test_gradients_are_finite_differences() -> None:
    """Thresholds are set where no pixel comes near them, so that the image is smooth."""
    settings = SplatSettings(alpha_threshold=1e-9, transmittance_cutoff=0.0, antialiased=True)
    scene, (poses, intrinsics) = scenes(1, 4), cameras(1, 2)
    renderer = ReferenceRenderer(settings)

    def planes(*leaves: Tensor) -> tuple[Tensor, ...]:
        found = renderer.from_cameras(GaussianBatch(*leaves[:5]), leaves[5], leaves[6], (3, 4))
        return found.image, found.depth, found.opacity

    leaves = [getattr(scene, name) for name in FIELDS] + [torch.linalg.inv(poses), intrinsics]
    assert torch.autograd.gradcheck(planes, [leaf.clone().requires_grad_() for leaf in leaves], fast_mode=True)


def test_batches_that_do_not_belong_together_are_refused() -> None:
    poses, intrinsics = cameras(2, 1)
    with pytest.raises(GeometryError, match="1 scenes, poses of shape"):
        ReferenceRenderer()(scenes(1, 3), poses, intrinsics, SIZE)

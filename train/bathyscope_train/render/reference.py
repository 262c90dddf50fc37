"""The renderer that defines what is right: every pixel meets every Gaussian, in plain torch.

It runs on any device, in the precision of what it is given, and autograd goes through it to the Gaussians, the
poses and the intrinsics. There are no tiles and no approximations; it is meant for small images and for tests.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from bathyscope.errors import GeometryError
from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.render.projection import Footprints, project

OPACITY_FLOOR = 1e-10
"""What the depth is divided by where nothing was blended."""


@dataclass(frozen=True, slots=True)
class Rendering:
    """b clips seen by t cameras each."""

    image: Float[Tensor, "b t 3 h w"]
    """RGB over the background, black without one; not clamped above."""
    depth: Float[Tensor, "b t h w"]
    """Expected z-depth: blended depth over blended opacity; 0 where opacity is 0."""
    accumulated: Float[Tensor, "b t h w"]
    """Blended z-depth, not divided: pulled towards 0 where opacity is below 1."""
    opacity: Float[Tensor, "b t h w"]


class Renderer(Protocol):
    """The operator R of Eq. 1: all Gaussians of a clip into each of its cameras."""

    def __call__(
        self,
        scene: GaussianBatch,
        world_from_camera: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """Render ``scene`` at ``size`` (height, width); ``intrinsics`` are in pixels of that size."""
        ...


@dataclass(frozen=True, slots=True)
class ReferenceRenderer:
    """A :class:`Renderer` that takes its time: b t h w n steps."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    """Constants of the formulas; the precision is that of the tensors."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind what is not opaque."""
    chunk: int = 1 << 20
    """Pairs of a pixel and a Gaussian worked on together; about 100 bytes each."""

    def __call__(
        self,
        scene: GaussianBatch,
        world_from_camera: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """Render ``scene``, see :class:`Renderer`.

        Raises:
            GeometryError: If the batches of scene, poses and intrinsics differ.
        """
        return self.from_cameras(scene, invert_rigid(world_from_camera), intrinsics, size)

    def from_cameras(
        self,
        scene: GaussianBatch,
        camera_from_world: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """The same for poses that are inverted already: gradients reach their entries."""
        clips, frames = camera_from_world.shape[:2]
        if len(scene.means) != clips or intrinsics.shape != (clips, frames, 3, 3):
            raise GeometryError(
                f"{len(scene.means)} scenes, poses of shape {tuple(camera_from_world.shape)} and intrinsics of shape "
                f"{tuple(intrinsics.shape)} do not belong together; needed are b, (b, t, 4, 4) and (b, t, 3, 3)"
            )
        views = [
            self._view(scene, clip, camera_from_world[clip, frame], intrinsics[clip, frame], size)
            for clip in range(clips)
            for frame in range(frames)
        ]
        planes = torch.stack(views).unflatten(0, (clips, frames))
        opacity, accumulated = planes[:, :, 0], planes[:, :, 1]
        behind = planes.new_tensor(self.background)[:, None, None] * (1 - opacity[:, :, None])
        depth = accumulated / opacity.clamp_min(OPACITY_FLOOR)
        return Rendering(planes[:, :, 2:] + behind, depth, accumulated, opacity)

    def _view(
        self, scene: GaussianBatch, clip: int, pose: Tensor, intrinsics: Tensor, size: tuple[int, int]
    ) -> Float[Tensor, "5 h w"]:
        """Opacity, accumulated depth and colour of one view."""
        found = project(scene, clip, camera_from_world=pose, intrinsics=intrinsics, size=size, settings=self.settings)
        features = torch.cat((torch.ones_like(found.depths)[:, None], found.depths[:, None], found.colours), -1)
        height, width = size
        rows = torch.arange(height, device=pose.device, dtype=pose.dtype) + 0.5
        columns = torch.arange(width, device=pose.device, dtype=pose.dtype) + 0.5
        pixels = torch.cartesian_prod(rows, columns).flip(-1)
        step = max(1, self.chunk // max(1, len(found.depths)))
        # Nothing of a chunk is kept for the backward pass but its pixels: it is worked out again there.
        blended = [
            checkpoint(blend, part, found, features, self.settings, use_reentrant=False) for part in pixels.split(step)
        ]
        planes: Tensor = torch.cat(blended).T.unflatten(-1, (height, width))
        return planes


def blend(
    pixels: Float[Tensor, "p 2"], found: Footprints, features: Float[Tensor, "m f"], settings: SplatSettings
) -> Float[Tensor, "p f"]:
    """Features weighted by what each Gaussian adds to each pixel, front to back.

    A pixel is finished by the Gaussian that would leave it no more light than the cut-off; that one is not added.
    """
    offsets = pixels[:, None] - found.means
    dx, dy = offsets[..., 0], offsets[..., 1]
    a, b, c = found.conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (found.opacities * torch.exp(-sigma.clamp_min(0))).clamp_max(settings.max_alpha)
    alpha = torch.where((alpha >= settings.alpha_threshold) & (sigma >= 0), alpha, 0)
    after = torch.cumprod(1 - alpha, dim=-1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), dim=-1)
    weights = torch.where(after > settings.transmittance_cutoff, alpha * before, 0)
    blended: Tensor = weights @ features
    return blended

"""The renderer that defines what is right: every pixel meets every Gaussian that can reach it, in plain torch.

It runs on any device, in the precision of what it is given, and autograd goes through it to the Gaussians, the
poses and the intrinsics. Nothing is approximated; it is meant for small images and for tests.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from bathyscope.splat import SplatSettings
from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.render.contract import Rendering, check_batch
from bathyscope_train.render.projection import Footprints, project


@dataclass(frozen=True, slots=True)
class ReferenceRenderer:
    """A :class:`~bathyscope_train.render.contract.Renderer` that takes its time."""

    settings: SplatSettings = field(default_factory=SplatSettings)
    """Constants of the formulas; the precision is that of the tensors."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind what is not opaque."""
    chunk: int = 1 << 20
    """Pairs of a pixel and a Gaussian worked on together; about 100 bytes each."""
    block: int = 16
    """Side in pixels of the squares of the image that Gaussians are looked up for; any gives the same picture."""

    def __call__(
        self,
        scene: GaussianBatch,
        world_from_camera: Float[Tensor, "b t 4 4"],
        intrinsics: Float[Tensor, "b t 3 3"],
        size: tuple[int, int],
    ) -> Rendering:
        """Render ``scene``, see :class:`~bathyscope_train.render.contract.Renderer`.

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
        check_batch(scene, camera_from_world, intrinsics)
        clips, frames = camera_from_world.shape[:2]
        views = [
            self._view(scene, clip, camera_from_world[clip, frame], intrinsics[clip, frame], size)
            for clip in range(clips)
            for frame in range(frames)
        ]
        return Rendering.of(torch.stack(views).unflatten(0, (clips, frames)), self.background)

    def _view(
        self, scene: GaussianBatch, clip: int, pose: Tensor, intrinsics: Tensor, size: tuple[int, int]
    ) -> Float[Tensor, "5 h w"]:
        """Opacity, accumulated depth and colour of one view."""
        found = project(scene, clip, camera_from_world=pose, intrinsics=intrinsics, size=size, settings=self.settings)
        height, width = size
        planes: Tensor = torch.cat(
            [
                torch.cat([self._block(found, top, left, size) for left in range(0, width, self.block)], dim=-1)
                for top in range(0, height, self.block)
            ],
            dim=-2,
        )
        return planes

    def _block(self, found: Footprints, top: int, left: int, size: tuple[int, int]) -> Float[Tensor, "5 p q"]:
        """The planes of one square of the image."""
        bottom, right = min(top + self.block, size[0]), min(left + self.block, size[1])
        rows, columns = torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5
        pixels = torch.cartesian_prod(rows, columns).flip(-1).to(found.means)
        near = found.near(pixels[0], pixels[-1])
        features = torch.cat((torch.ones_like(near.depths)[:, None], near.depths[:, None], near.colours), -1)
        step = max(1, self.chunk // max(1, len(near.depths)))
        # Nothing of a chunk is kept for the backward pass but its pixels: it is worked out again there.
        blended = [
            checkpoint(blend, part, near, features, self.settings, use_reentrant=False) for part in pixels.split(step)
        ]
        planes: Tensor = torch.cat(blended).T.unflatten(-1, (bottom - top, right - left))
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

"""What every renderer takes and gives: the operator R of Eq. 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.model.gaussian_parameters import GaussianBatch

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

    @classmethod
    def of(cls, planes: Float[Tensor, "b t 5 h w"], background: tuple[float, float, float]) -> Rendering:
        """From what is blended: opacity, accumulated depth and RGB, in this order."""
        opacity, accumulated = planes[:, :, 0], planes[:, :, 1]
        behind = planes.new_tensor(background)[:, None, None] * (1 - opacity[:, :, None])
        depth = accumulated / opacity.clamp_min(OPACITY_FLOOR)
        return cls(planes[:, :, 2:] + behind, depth, accumulated, opacity)


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


def check_batch(
    scene: GaussianBatch, camera_from_world: Float[Tensor, "b t 4 4"], intrinsics: Float[Tensor, "b t 3 3"]
) -> None:
    """Refuse scenes, poses and intrinsics that are not of one batch.

    Raises:
        GeometryError: If the shapes do not belong together.
    """
    clips, frames = camera_from_world.shape[:2]
    if len(scene.means) != clips or intrinsics.shape != (clips, frames, 3, 3):
        raise GeometryError(
            f"{len(scene.means)} scenes, poses of shape {tuple(camera_from_world.shape)} and intrinsics of shape "
            f"{tuple(intrinsics.shape)} do not belong together; needed are b, (b, t, 4, 4) and (b, t, 3, 3)"
        )

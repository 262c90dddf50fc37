"""From a prediction to a scene: cameras and Gaussians in one world, whose frame 0 is the identity."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope.gaussians import Gaussians
from bathyscope_train.model.gaussian_parameters import GaussianBatch, anysplat_gaussians, footprint_gaussians
from bathyscope_train.model.network import DenseMaps, Prediction
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.presets import SceneSettings
from bathyscope_train.model.unprojection import invert_rigid, unproject
from bathyscope_train.model.voxels import fuse_batch


@dataclass(frozen=True, slots=True)
class Scene:
    """Cameras and Gaussians of b clips of t frames."""

    world_from_camera: Float[Tensor, "b t 4 4"]
    """Camera poses; frame 0 is the identity, unless re-basing was switched off."""
    intrinsics: Float[Tensor, "b t 3 3"]
    """In pixels of the predicted maps."""
    gaussians: GaussianBatch

    def numpy(self, clip: int = 0) -> Gaussians:
        """The Gaussians of one clip as the numpy type that the splatter of the service takes."""
        batch = self.gaussians
        fields = (batch.means, batch.rotations, batch.scales, batch.opacities, batch.harmonics)
        return Gaussians(*(field[clip].detach().float().cpu().numpy() for field in fields))


def assemble_scene(
    prediction: Prediction,
    images: Float[Tensor, "b t 3 h w"],
    settings: SceneSettings,
    *,
    rebase: bool = True,
) -> Scene:
    """Decode cameras, unproject depth, activate (and, where the preset says so, fuse) the Gaussians.

    Args:
        prediction: What the network said about ``images``.
        images: RGB in [0, 1].
        settings: The preset's reading of the raw maps.
        rebase: Re-express everything so that frame 0 is the identity. Off, the world is the network's own, in
            which the first camera is only near the identity; the published pipeline stops there.

    Raises:
        GeometryError: If the network has no Gaussian head.
    """
    maps = prediction.maps
    size = (maps.depth.shape[-2], maps.depth.shape[-1])
    cameras = decode_cameras(prediction.pose_encoding, size, focal_epsilon=settings.focal_epsilon)
    world_from_camera = invert_rigid(cameras.camera_from_world)
    gaussians = world_gaussians(maps, images, world_from_camera, cameras.intrinsics, settings)
    if rebase:
        first = cameras.camera_from_world[:, 0]
        world_from_camera = _first_is_identity(first[:, None] @ world_from_camera)
        gaussians = gaussians.moved(first)
    return Scene(world_from_camera, cameras.intrinsics, gaussians)


def world_gaussians(
    maps: DenseMaps,
    images: Tensor,
    world_from_camera: Float[Tensor, "b t 4 4"],
    intrinsics: Float[Tensor, "b t 3 3"],
    settings: SceneSettings,
) -> GaussianBatch:
    """The Gaussians of all frames in the world of their cameras.

    Raises:
        GeometryError: If the network has no Gaussian head.
    """
    if maps.gaussians is None:
        raise GeometryError("a scene needs Gaussians; this network has no Gaussian head")
    points = unproject(maps.depth, intrinsics, world_from_camera, pixel_center=settings.pixel_center).flatten(2, 3)
    raw = maps.gaussians.flatten(3).transpose(2, 3)
    features, confidence = raw[..., :-1], raw[..., -1]
    if settings.activation == "anysplat":
        points, features = points.flatten(1, 2), features.flatten(1, 2)
        if settings.voxel_size is not None:
            points, features = fuse_batch(points, features, confidence.flatten(1), voxel_size=settings.voxel_size)
        return anysplat_gaussians(points, features, opacity_exponent=settings.opacity_exponent)
    inverse_focal = (1 / intrinsics[..., 0, 0] + 1 / intrinsics[..., 1, 1]) / 2
    return footprint_gaussians(
        points,
        features,
        footprint=maps.depth.flatten(2) * inverse_focal[..., None],
        colours=images.flatten(3).transpose(2, 3),
        rotation=world_from_camera[..., :3, :3],
    )


def _first_is_identity(poses: Float[Tensor, "b t 4 4"]) -> Float[Tensor, "b t 4 4"]:
    """``poses`` with the first one, which is the identity but for rounding, made exact."""
    identity = torch.eye(4, dtype=poses.dtype, device=poses.device).expand(poses.shape[0], 1, 4, 4)
    return torch.cat((identity, poses[:, 1:]), dim=1)

"""Cameras for networks that have none, so that they can be trained by what cameras make possible.

The cameras of a clip come from its data set, from a network of ours, or from EndoDAC's pose networks. A source that has
depth of its own hands it on: it tells how long the unit of its poses is in the scene.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import SettingsError
from bathyscope_train.model.network import Network
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.systems.endodac.loading import EndoDacNetworks
from bathyscope_train.systems.endodac.pose import average_intrinsics, motion_matrix
from bathyscope_train.systems.endodac.system import POSE_SIZE


@dataclass(frozen=True, slots=True)
class ClipCameras:
    """Cameras of b clips of t frames; frame 0 is the identity."""

    world_from_camera: Float[Tensor, "b t 4 4"]
    intrinsics: Float[Tensor, "b t 3 3"]
    """In pixels of the images they were made for."""
    depth: Float[Tensor, "b t h w"] | None = None
    """Z-depth of the same frames in the unit of the poses, of whatever quality; 0 where there is none."""


class CameraSource(Protocol):
    """Another system's cameras."""

    def __call__(self, images: Float[Tensor, "b t 3 h w"]) -> ClipCameras:
        """Cameras of clips of images in [0, 1]; no gradient reaches the other system."""
        ...


@dataclass(frozen=True, slots=True)
class NetworkCameras:
    """Cameras and depth of a network of ours, as it is."""

    network: Network

    @torch.no_grad()
    def __call__(self, images: Float[Tensor, "b t 3 h w"]) -> ClipCameras:
        """See :class:`CameraSource`."""
        prediction = self.network(images)
        size = (images.shape[-2], images.shape[-1])
        epsilon = self.network.preset.scene.focal_epsilon
        cameras = decode_cameras(prediction.pose_encoding, size, focal_epsilon=epsilon)
        poses = cameras.camera_from_world[:, :1] @ invert_rigid(cameras.camera_from_world)
        return ClipCameras(poses, cameras.intrinsics, prediction.maps.depth)


@dataclass(frozen=True, slots=True)
class EndoDacCameras:
    """EndoDAC's pose and depth networks, which share one unit: motions from frame to frame, one after the other.

    Raises:
        SettingsError: If the networks were loaded without pose networks.
    """

    networks: EndoDacNetworks

    def __post_init__(self) -> None:
        if self.networks.pose is None:
            raise SettingsError("EndoDAC without pose_encoder.pth and pose.pth has no cameras; give the whole folder")

    @torch.no_grad()
    def __call__(self, images: Float[Tensor, "b t 3 h w"]) -> ClipCameras:
        """See :class:`CameraSource`."""
        b, t, _, height, width = images.shape
        pose = self.networks.pose
        assert pose is not None
        small = F.interpolate(images.flatten(0, 1), POSE_SIZE, mode="area").unflatten(0, (b, t))
        source = small[:, : max(t - 1, 1)]  # a single frame is paired with itself
        target = small[:, 1:] if t > 1 else small
        motion = pose.decoder(pose.encoder(source.flatten(0, 1), target.flatten(0, 1))[-1])
        steps = motion_matrix(motion.axis_angle, motion.translation).unflatten(0, (b, -1))
        if pose.intrinsics is None:
            intrinsics = average_intrinsics((height, width)).to(images).expand(b, t, 3, 3)
        else:
            each = pose.intrinsics(motion.features, (height, width)).unflatten(0, (b, -1))
            intrinsics = each.mean(1, keepdim=True).expand(b, t, 3, 3)
        depth = self.networks.depth.depth(images.flatten(0, 1))[:, None]
        depth = F.interpolate(depth, (height, width), mode="bilinear", align_corners=False)[:, 0]
        return ClipCameras(_chain(steps, t), intrinsics, depth.unflatten(0, (b, t)))


def _chain(steps: Float[Tensor, "b s 4 4"], frames: int) -> Float[Tensor, "b t 4 4"]:
    """Poses of which each is the one before times a step; the first is the identity."""
    poses = [torch.eye(4, device=steps.device, dtype=steps.dtype).expand(steps.shape[0], 4, 4)]
    for step in range(frames - 1):
        poses.append(poses[-1] @ steps[:, step])
    return torch.stack(poses, 1)

"""What the network says about clips, as geometry: depth, cameras and Gaussians in one world."""

from dataclasses import dataclass, replace
from typing import Literal, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from bathyscope_train.model.gaussian_parameters import GaussianBatch
from bathyscope_train.model.matching_camera_head import CameraSolution, MatchingCameraHead, PlacedMatches
from bathyscope_train.model.network import DenseMaps, Features, Network, Prediction
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.scene import assemble_scene
from bathyscope_train.model.unprojection import invert_rigid

_NOTHING = -1e4
"""Raw opacity and fusion weight of pixels that must not become Gaussians; the sigmoid of it is exactly 0."""


@dataclass(frozen=True, slots=True)
class ClipGeometry:
    """b clips of t frames; frame 0 is the identity."""

    depth: Float[Tensor, "b t h w"]
    """Of the depth head, as the camera head corrected it."""
    world_from_camera: Float[Tensor, "b t 4 4"]
    intrinsics: Float[Tensor, "b t 3 3"]
    gaussians: GaussianBatch | None
    """None for a network without a Gaussian head."""
    seen: PlacedMatches | None = None
    """None for a network that does not match, and where its cameras are not taken as given."""


@dataclass(frozen=True, slots=True)
class SolvedBefore:
    """What the network said before training, to be kept: cameras in a unit that depth cannot change any more."""

    pose_encodings: Float[Tensor, "i b t 9"]
    correction: Float[Tensor, "b t h w"]
    """Factor from the depth head's depth to the corrected one."""


def encode(network: Network, images: Float[Tensor, "b t 3 h w"], *, trained: bool, autocast: bool = False) -> Features:
    """Tokens of the transformer, in bfloat16 if ``autocast``; without gradients unless it is ``trained``."""
    with (
        torch.set_grad_enabled(trained and torch.is_grad_enabled()),
        torch.autocast(images.device.type, dtype=torch.bfloat16, enabled=autocast),
    ):
        return network.encode(images)


def predict(
    network: Network,
    features: Features,
    images: Float[Tensor, "b t 3 h w"],
    inside: Bool[Tensor, "b h w"],
    focal: Float[Tensor, "b"] | None = None,
    *,
    cameras: Literal["given", "through"] = "through",
    before: SolvedBefore | None = None,
    chunk: int | None = None,
) -> ClipGeometry:
    """Heads and scene, in float32.

    Args:
        network: Its heads are used.
        features: Of ``images``.
        images: RGB in [0, 1].
        inside: Field of view; what is outside never becomes a Gaussian.
        focal: Focal length in pixels where known, 0 elsewhere.
        cameras: Whether gradients go through the camera head, or it is taken as given, see :func:`given_solution`.
        before: Cameras and correction of depth to take instead of asking the camera head.
        chunk: Frames that the dense heads work on at once; what they keep is worked out again going back.
    """
    maps = dense_maps(network, features, images, chunk)
    if before is not None:
        solved = CameraSolution(before.pose_encodings, maps.depth * before.correction)
    elif cameras == "given":
        solved = given_solution(network, features, maps.depth, focal)
    else:
        solved = network.cameras(features, maps.depth, focal)
    maps = replace(maps, depth=solved.depth, gaussians=_only_inside(maps.gaussians, inside))
    return replace(assemble(network, Prediction(solved.pose_encodings, maps), images), seen=solved.seen)


@torch.no_grad()
def predict_before(
    network: Network,
    features: Features,
    images: Float[Tensor, "b t 3 h w"],
    focal: Float[Tensor, "b"] | None = None,
) -> tuple[ClipGeometry, SolvedBefore]:
    """Depth and cameras of the network before training, which has no Gaussian head, and how they came about."""
    maps = network.dense(features, images)
    solved = network.cameras(features, maps.depth, focal)
    geometry = assemble(network, Prediction(solved.pose_encodings, replace(maps, depth=solved.depth)), images)
    return geometry, SolvedBefore(solved.pose_encodings, solved.depth / maps.depth)


def given_solution(
    network: Network, features: Features, depth: Float[Tensor, "b t h w"], focal: Float[Tensor, "b"] | None
) -> CameraSolution:
    """Cameras as they are for this depth, without gradients of their own.

    A head that solves for motion measures it in the depth's own unit. Its translations follow the mean depth of the
    clip, so that depth that grows or shrinks as a whole takes the cameras along and no loss can gain by it. Other heads
    measure translations by themselves, and these stay.
    """
    solved = network.cameras(features, depth, focal, given=True)
    encodings = solved.pose_encodings
    if isinstance(network.camera_head, MatchingCameraHead):
        mean = depth.mean((1, 2, 3))
        growth = (mean / mean.detach())[None, :, None, None]
        encodings = torch.cat((encodings[..., :3] * growth, encodings[..., 3:]), dim=-1)
    return CameraSolution(encodings, solved.depth, solved.seen)


def dense_maps(
    network: Network, features: Features, images: Float[Tensor, "b t 3 h w"], chunk: int | None = None
) -> DenseMaps:
    """Dense heads on all frames, or on ``chunk`` frames at a time with their activations thrown away meanwhile."""
    frames = images.shape[1]
    if chunk is None or chunk >= frames:
        return network.dense(features, images)
    parts = []
    for start in range(0, frames, chunk):
        some = slice(start, start + chunk)
        part = Features(
            taps=tuple(tap[:, some] for tap in features.taps),
            camera=features.camera[:, some],
            stem_maps=tuple(maps[:, some] for maps in features.stem_maps),
        )
        done = checkpoint(network.dense, part, images[:, some], use_reentrant=False)
        parts.append(cast("DenseMaps", done))
    gaussians = [part.gaussians for part in parts if part.gaussians is not None]
    return DenseMaps(
        depth=torch.cat([part.depth for part in parts], 1),
        confidence=torch.cat([part.confidence for part in parts], 1),
        gaussians=torch.cat(gaussians, 1) if gaussians else None,
    )


def assemble(network: Network, prediction: Prediction, images: Float[Tensor, "b t 3 h w"]) -> ClipGeometry:
    """Cameras, and Gaussians where there are any, in the world of frame 0."""
    settings, depth = network.preset.scene, prediction.maps.depth
    if prediction.maps.gaussians is not None:
        scene = assemble_scene(prediction, images, settings)
        return ClipGeometry(depth, scene.world_from_camera, scene.intrinsics, scene.gaussians)
    size = (depth.shape[-2], depth.shape[-1])
    cameras = decode_cameras(prediction.pose_encoding, size, focal_epsilon=settings.focal_epsilon)
    poses = cameras.camera_from_world[:, :1] @ invert_rigid(cameras.camera_from_world)
    return ClipGeometry(depth, poses, cameras.intrinsics, None)


def _only_inside(raw: Float[Tensor, "b t g h w"] | None, inside: Bool[Tensor, "b h w"]) -> Tensor | None:
    """Raw Gaussians without those of pixels outside: no opacity, no say when voxels are fused, no gradient."""
    if raw is None:
        return None
    hidden = ~inside[:, None]
    opacity, weight = (raw[:, :, channel].masked_fill(hidden, _NOTHING) for channel in (0, -1))
    return torch.cat((opacity[:, :, None], raw[:, :, 1:-1], weight[:, :, None]), dim=2)

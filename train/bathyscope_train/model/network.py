"""The whole network: encode a clip, predict dense maps frame by frame, predict cameras.

The three stages are methods of their own because a bundle runs them apart: the transformer once a clip,
the dense heads in chunks of frames, the cameras last. :meth:`Network.forward` puts them together.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope.errors import GeometryError
from bathyscope_train.model.aggregator import Aggregator
from bathyscope_train.model.camera_head import CameraHead
from bathyscope_train.model.dense_head import DepthHead, activate_depth
from bathyscope_train.model.gaussian_head import GaussianHead
from bathyscope_train.model.light_dense_head import LightDepthHead, LightGaussianHead
from bathyscope_train.model.matching_camera_head import CameraSolution, MatchingCameraHead
from bathyscope_train.model.presets import (
    ConvStemSettings,
    LightHeadSettings,
    MatchingCameraSettings,
    NetworkPreset,
)


@dataclass(frozen=True, slots=True)
class Features:
    """What the heads read of a clip."""

    taps: tuple[Float[Tensor, "b t n c"], ...]
    """Patch tokens of the tapped layers, shallow to deep."""
    camera: Float[Tensor, "b t c"]
    """Camera token of the last layer."""
    stem_maps: tuple[Float[Tensor, "b t c h w"], ...] = ()
    """Maps of the image stem, where the preset's stem keeps some."""


@dataclass(frozen=True, slots=True)
class DenseMaps:
    """Per-pixel predictions of every frame."""

    depth: Float[Tensor, "b t h w"]
    """Z-depth, relative, positive."""
    confidence: Float[Tensor, "b t h w"]
    """Confidence of the depth, above 1."""
    gaussians: Float[Tensor, "b t g h w"] | None
    """Raw Gaussian parameters (see :mod:`~bathyscope_train.model.gaussian_parameters`); None without that head."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Everything the network says about a clip."""

    pose_encodings: Float[Tensor, "i b t 9"]
    """Pose encodings after each iteration of the camera head (see :mod:`~bathyscope_train.model.pose_encoding`)."""
    maps: DenseMaps
    single_view_depth: Float[Tensor, "b t h w"] | None = None
    """Depth before the motion between the frames corrected it, as the network gave it."""

    @property
    def pose_encoding(self) -> Float[Tensor, "b t 9"]:
        """The final pose encoding."""
        return self.pose_encodings[-1]


class Network(nn.Module):
    """Cameras, depth and Gaussians for the frames of a clip, in one pass.

    Parameters are named as in the published checkpoints (without their ``encoder.`` prefix).
    """

    def __init__(self, preset: NetworkPreset) -> None:
        super().__init__()
        self.preset = preset
        self.aggregator = Aggregator(preset)
        self.camera_head = build_camera_head(preset)
        self.depth_head = build_depth_head(preset)
        self.gaussian_param_head = build_gaussian_head(preset)

    def encode(self, images: Float[Tensor, "b t 3 h w"]) -> Features:
        """Run the transformer over clips of images in [0, 1].

        Raises:
            GeometryError: If a side of the images is not a multiple of the patch size.
        """
        height, width = images.shape[-2:]
        patch = self.preset.patch_size
        if height % patch or width % patch:
            raise GeometryError(f"images of {height}x{width} do not divide into patches of {patch}; resize them first")
        layers, stem_maps = self.aggregator(images)
        special = self.aggregator.special
        return Features(
            taps=tuple(layers[index][:, :, special:] for index in self.preset.aggregator.taps),
            camera=layers[self.preset.aggregator.depth - 1][:, :, 0],
            stem_maps=stem_maps,
        )

    def dense(self, features: Features, images: Float[Tensor, "b t 3 h w"]) -> DenseMaps:
        """Depth, confidence and raw Gaussians of every frame; frames do not see each other here."""
        b, t = images.shape[:2]
        frames = images.flatten(0, 1)
        with _float32(images.device):
            taps = [tokens.flatten(0, 1).float() for tokens in features.taps]
            maps = [each.flatten(0, 1).float() for each in features.stem_maps]
            depth, confidence = activate_depth(self._raw_depth(taps, frames, maps))
            raw = self._raw_gaussians(taps, frames, maps, depth)
        return DenseMaps(
            depth=depth.unflatten(0, (b, t)),
            confidence=confidence.unflatten(0, (b, t)),
            gaussians=None if raw is None else raw.unflatten(0, (b, t)),
        )

    def _raw_depth(self, taps: list[Tensor], frames: Tensor, stem_maps: list[Tensor]) -> Tensor:
        if isinstance(self.depth_head, LightDepthHead):
            light: Tensor = self.depth_head(taps, frames, stem_maps)
            return light
        raw: Tensor = self.depth_head(taps, frames)
        return raw

    def _raw_gaussians(
        self, taps: list[Tensor], frames: Tensor, stem_maps: list[Tensor], depth: Tensor
    ) -> Tensor | None:
        if self.gaussian_param_head is None:
            return None
        if isinstance(self.gaussian_param_head, LightGaussianHead):
            return self.gaussian_param_head.predict(taps, frames, stem_maps, depth)
        raw: Tensor = self.gaussian_param_head(taps, frames)
        return raw

    def cameras(
        self,
        features: Features,
        depth: Float[Tensor, "b t h w"],
        focal: Float[Tensor, "b"] | None = None,
        *,
        given: bool = False,
    ) -> CameraSolution:
        """Pose encodings after each iteration, and the depth as corrected by the motion between the frames.

        Args:
            features: Of the clips.
            depth: Of the depth head.
            focal: Focal length in pixels where it is known, 0 where not.
            given: Take cameras as given: gradients reach the depth and its correction only.
        """
        with _float32(features.camera.device):
            camera = features.camera.float()
            if isinstance(self.camera_head, MatchingCameraHead):
                maps = [each.float() for each in features.stem_maps]
                head = self.camera_head.take_as_given if given else self.camera_head
                solved: CameraSolution = head(camera, features.taps[-1].float(), maps, depth.float(), focal)
                return solved
            encodings = self.camera_head(camera)
            return CameraSolution(encodings.detach() if given else encodings, depth)

    def forward(self, images: Float[Tensor, "b t 3 h w"], focal: Float[Tensor, "b"] | None = None) -> Prediction:
        """Predict everything for clips of images in [0, 1]; sides are multiples of the patch size.

        Args:
            images: The clips.
            focal: Focal length in pixels where it is known, 0 where not; only the matching camera head makes use of it.
        """
        features = self.encode(images)
        maps = self.dense(features, images)
        solved = self.cameras(features, maps.depth, focal)
        return Prediction(solved.pose_encodings, replace(maps, depth=solved.depth), maps.depth)


def build_camera_head(preset: NetworkPreset) -> nn.Module:
    """The camera head that ``preset.camera`` asks for."""
    settings, width = preset.camera, 2 * preset.aggregator.width
    if isinstance(settings, MatchingCameraSettings):
        return MatchingCameraHead(
            width,
            stem_channels=2 * _stem_channels(preset),
            patch_size=preset.patch_size,
            settings=settings,
        )
    return CameraHead(
        width=width,
        depth=settings.depth,
        heads=settings.heads,
        iterations=settings.iterations,
        mlp_ratio=preset.aggregator.mlp_ratio,
        layer_scale=settings.layer_scale,
    )


def build_depth_head(preset: NetworkPreset) -> nn.Module:
    """The depth head that ``preset.depth`` asks for."""
    settings, width = preset.depth, 2 * preset.aggregator.width
    if isinstance(settings, LightHeadSettings):
        return LightDepthHead(
            width,
            len(preset.aggregator.taps),
            settings,
            stem_channels=_stem_channels(preset),
            patch_size=preset.patch_size,
        )
    return DepthHead(width, settings, patch_size=preset.patch_size)


def build_gaussian_head(preset: NetworkPreset) -> nn.Module | None:
    """The Gaussian head that ``preset.gaussians`` asks for, if any; it ends in a fusion confidence channel."""
    settings, width, outputs = preset.gaussians, 2 * preset.aggregator.width, preset.gaussian_channels + 1
    if settings is None:
        return None
    if isinstance(settings, LightHeadSettings):
        return LightGaussianHead(
            width,
            len(preset.aggregator.taps),
            settings,
            stem_channels=_stem_channels(preset),
            patch_size=preset.patch_size,
            outputs=outputs,
        )
    return GaussianHead(
        width,
        settings,
        outputs=outputs,
        patch_size=preset.patch_size,
    )


def _stem_channels(preset: NetworkPreset) -> int:
    """Channels of the stem's half-size map; the preset has checked that there is one."""
    assert isinstance(preset.stem, ConvStemSettings)
    return preset.stem.channels


@contextmanager
def _float32(device: torch.device) -> Iterator[None]:
    """Heads stay in float32 when the caller runs the transformer under autocast."""
    if torch.is_autocast_enabled(device.type):
        with torch.autocast(device.type, enabled=False):
            yield
    else:
        yield

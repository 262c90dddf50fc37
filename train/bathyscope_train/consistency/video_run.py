"""Video Depth Anything under L_3D and L_temp (Table 3): the same run, with cameras of another system or of the data."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from torch import nn

from bathyscope.errors import SettingsError
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.consistency.start import video_kind
from bathyscope_train.consistency.trainer import ConsistencyRun
from bathyscope_train.consistency.video_step import VideoStep
from bathyscope_train.data.clip_loader import FrameBatch
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.model.unprojection import invert_rigid
from bathyscope_train.systems.camera_sources import CameraSource, ClipCameras, EndoDacCameras, NetworkCameras
from bathyscope_train.systems.endodac.loading import DEPTH_FILE, load_networks
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.system import is_metric, load_vda
from bathyscope_train.systems.vda.training import VdaGeometry

_LONGEST, _PATCH = 32, 14
DATA = "data"
"""``cameras_from``: the poses that come with the videos."""


class VideoRun(ConsistencyRun):
    """One process's side of a run; the weights that it writes have the published names.

    Raises:
        SettingsError: If the settings ask for what a network without cameras and Gaussians has not.
    """

    def _initial(self) -> nn.Module:
        settings = self.settings
        kind = video_kind(settings.init, settings.preset)
        assert kind is not None
        self.metric = is_metric(kind.name)
        check_video_settings(settings, metric=self.metric)
        return load_vda(settings.init, kind.name)

    def _objective(self) -> VideoStep:
        settings = self.settings
        geometry = VdaGeometry(
            cast(VideoDepthAnything, self.network),
            None if settings.cameras_from == DATA else self._source(Path(str(settings.cameras_from))),
            metric=self.metric,
            nominal_depth=settings.nominal_depth,
        )
        return VideoStep(geometry, settings)

    def _source(self, path: Path) -> CameraSource:
        """The other system, loaded."""
        device = self.processes.device
        if path.is_dir() and (path / DEPTH_FILE).is_file():
            networks = load_networks(path)
            for module in (networks.depth, *(networks.pose.modules if networks.pose is not None else ())):
                module.to(device).requires_grad_(False)
            return EndoDacCameras(networks)
        network, _ = load_network(path)
        return NetworkCameras(network.to(device).requires_grad_(False))

    def _parts(self, batch: FrameBatch) -> Sequence[tuple[Any, ...]]:
        count, device = self.settings.accumulate, self.processes.device
        images, inside = (values.to(device).chunk(count) for values in (batch.images, batch.inside))
        if self.settings.cameras_from != DATA:
            return [(images[number], inside[number], None) for number in range(count)]
        if batch.world_from_camera is None or batch.intrinsics is None:
            raise SettingsError(f"{', '.join(batch.names)}: no poses or intrinsics; cameras_from=data needs them")
        poses = invert_rigid(batch.world_from_camera[:, :1]) @ batch.world_from_camera
        intrinsics = batch.intrinsics[:, None].expand(-1, poses.shape[1], -1, -1)
        given = zip(poses.to(device).chunk(count), intrinsics.to(device).chunk(count), strict=True)
        return [(images[number], inside[number], ClipCameras(*cameras)) for number, cameras in enumerate(given)]

    def _validate(self) -> None:
        """Held-out folders are measured by ``bathyscope evaluate``; the settings name none."""

    def _result(self) -> nn.Module:
        network = copy.deepcopy(self.network).cpu()
        if self.average is not None:
            network.load_state_dict(self.average)
        return network.eval()


def check_video_settings(settings: ConsistencySettings, *, metric: bool) -> None:
    """Refuse what cannot be trained.

    Raises:
        SettingsError: Names the setting and what to give instead.
    """
    if settings.loss.image.weight > 0:
        raise SettingsError("a video network renders no image; set loss.image.weight=0")
    if settings.cameras_from is None:
        raise SettingsError("a video network has no cameras; set cameras_from= a checkpoint of ours, EndoDAC, or data")
    if settings.cameras_from == DATA and not metric and settings.nominal_depth is None:
        raise SettingsError("poses of the data come without depth; set nominal_depth, in the unit of the poses")
    if settings.cameras_from == DATA and settings.balance_steps:
        raise SettingsError("balance_steps needs cameras that come with any window; set balance_steps=0")
    if settings.window.frames > _LONGEST or settings.window.patch != _PATCH:
        raise SettingsError(
            f"windows of a video network have at most {_LONGEST} frames in patches of {_PATCH} pixels, settings say "
            f"{settings.window.frames} and {settings.window.patch}"
        )
    if settings.validation:
        raise SettingsError("a video network is measured by `bathyscope evaluate`; set validation=[]")

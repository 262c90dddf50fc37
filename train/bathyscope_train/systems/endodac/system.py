"""EndoDAC as a system: depth of single frames and, with its pose networks, a chain of cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bathyscope.bundle import hash_file
from bathyscope.camera import F64, Size
from bathyscope.clip import FrameSequence
from bathyscope.vision.shorter_side import covering_size, to_network
from bathyscope_train.systems.endodac.loading import DEPTH_FILE, EndoDacNetworks, PoseNetworks, load_networks
from bathyscope_train.systems.endodac.pose import average_intrinsics, motion_matrix
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import F32, FrameEstimate, SystemInfo, SystemOptions

BATCH = 8
"""Frames that the depth network sees at once, without a link between them."""

POSE_SIZE = (256, 320)
"""(height, width) at which the pose networks were trained."""

Picture = NDArray[np.uint8]


class Camera(NamedTuple):
    """Where a frame was taken."""

    world_from_camera: F64
    intrinsics: F64


def open_endodac(path: Path, name: str, options: SystemOptions) -> EndoDacSystem:
    """The system of published weights: a depth checkpoint, or the project's folder with the pose networks beside it.

    Raises:
        CheckpointError: If a file does not hold exactly its network.
        SettingsError: If an option other than ``device`` is set.
    """
    refuse_options(name, options, takes=("device",))
    networks = load_networks(path)
    file = path / DEPTH_FILE if path.is_dir() else path
    return endodac_system(networks, name=name, device=options.device, sha256=hash_file(file).sha256)


def endodac_system(
    networks: EndoDacNetworks, *, name: str, device: str = "cpu", sha256: str | None = None
) -> EndoDacSystem:
    """Loaded networks as a system."""
    pose = networks.pose
    networks.depth.to(device)
    for module in () if pose is None else pose.modules:
        module.to(device)
    height, width = networks.depth.settings.image_size
    details: dict[str, str | int | float] = {"input_size": f"{height}x{width}"}
    if pose is not None:
        details["intrinsics"] = "SCARED's average" if pose.intrinsics is None else "learnt, of each pair of frames"
    info = SystemInfo(
        name=name,
        quantity="depth",
        scale="relative",
        cameras=pose is not None,
        weights_sha256=sha256,
        details=details,
    )
    return EndoDacSystem(info, networks)


@dataclass(frozen=True)
class EndoDacSystem:
    """Frames are resized as in EndoDAV's comparison; scaled disparity is resized back as in EndoDAC's own evaluation.

    That is: bicubic to the smallest size of the frame's aspect that covers the network's, then bilinear to the
    network's; and OpenCV's bilinear (half-pixel) of the *scaled disparity* to the frame's size, then inverted.
    """

    info: SystemInfo
    networks: EndoDacNetworks

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`.

        Where the system has cameras, ``intrinsics`` go before what the intrinsics head says of each frame.
        """
        everywhere = np.ones(frames.size, np.bool_)
        chain = None if self.networks.pose is None else CameraChain(self.networks.pose, frames, intrinsics)
        for start in range(0, len(frames), BATCH):
            indexes = range(start, min(start + BATCH, len(frames)))
            depths = self.depths([frames.image(index) for index in indexes])
            for index, depth in zip(indexes, depths, strict=True):
                camera = None if chain is None else chain.camera(index)
                yield FrameEstimate(
                    index=index,
                    values=depth,
                    valid=everywhere,
                    world_from_camera=None if camera is None else camera.world_from_camera,
                    intrinsics=None if camera is None else camera.intrinsics,
                )

    @torch.inference_mode()
    def depths(self, pictures: list[Picture]) -> Iterator[F32]:
        """Depth (h, w) of each of some frames of one size (h, w, 3), relative."""
        network = self.networks.depth
        frame: Size = (pictures[0].shape[0], pictures[0].shape[1])
        size = covering_size(frame, network.settings.image_size)
        images = torch.from_numpy(np.stack([to_network(picture, size) for picture in pictures]))
        scaled = network.scaled_disparity(images.to(next(network.parameters()).device)).cpu().numpy()
        for disparity in scaled:
            resized = cv2.resize(disparity, (frame[1], frame[0]), interpolation=cv2.INTER_LINEAR)
            yield np.asarray(1 / resized, np.float32)


class CameraChain:
    """Cameras of a clip, frame by frame in order: each motion from the frame before is composed with what came before.

    Args:
        networks: The pose networks.
        frames: The clip.
        intrinsics: (3, 3) at the size of the frames, if known.
    """

    def __init__(self, networks: PoseNetworks, frames: FrameSequence, intrinsics: F64 | None) -> None:
        self._networks, self._frames, self._given = networks, frames, intrinsics
        self._world: F64 = np.eye(4)
        self._last: Tensor | None = None

    @torch.inference_mode()
    def camera(self, index: int) -> Camera:
        """Camera of frame ``index``, which must be the one after the last that was asked for.

        The first frame's intrinsics come from the pair with the second one, where there is one.
        """
        target = self._picture(index)
        if self._last is None:
            source = self._picture(index + 1) if index + 1 < len(self._frames) else target
            _, intrinsics = self._pair(source, target)
        else:
            motion, intrinsics = self._pair(self._last, target)
            self._world = self._world @ motion
        self._last = target
        return Camera(self._world, intrinsics if self._given is None else self._given)

    def _pair(self, source: Tensor, target: Tensor) -> tuple[F64, F64]:
        """Motion that maps points of the target's camera to the source's, and intrinsics at the frames' size."""
        networks = self._networks
        motion = networks.decoder(networks.encoder(source, target)[-1])
        matrix = motion_matrix(motion.axis_angle[0].double(), motion.translation[0].double())
        if networks.intrinsics is None:
            intrinsics = average_intrinsics(self._frames.size)
        else:
            intrinsics = networks.intrinsics(motion.features, self._frames.size)[0]
        return matrix.cpu().numpy(), intrinsics.double().cpu().numpy()

    def _picture(self, index: int) -> Tensor:
        """A frame as (1, 3, h, w) at the pose networks' size, by area: it is mostly made smaller."""
        height, width = POSE_SIZE
        small = cv2.resize(self._frames.image(index), (width, height), interpolation=cv2.INTER_AREA)
        image = torch.from_numpy(small).to(next(self._networks.encoder.parameters()).device)
        return image.permute(2, 0, 1)[None].float() / 255

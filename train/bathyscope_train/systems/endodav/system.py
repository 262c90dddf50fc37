"""EndoDAV as a system: windows of frames to disparity, stitched, then depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bathyscope.bundle import hash_file
from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope.depth_range import DepthRange
from bathyscope.keyed_windows import KeyedWindows
from bathyscope.vision.shorter_side import covering_size, to_network
from bathyscope_train.systems.endodav.loading import describe, load_endodav
from bathyscope_train.systems.endodav.network import EndoDav
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import F32, FrameEstimate, SystemInfo, SystemOptions
from bathyscope_train.systems.windowed_video import WindowedVideoSystem

WINDOWS = KeyedWindows(key_places=(6, 12, *range(24, 32)), fit="blended")
"""Video Depth Anything's windows with other key frames; scale and shift are fitted on the eight blended frames."""


def open_endodav(path: Path, name: str, options: SystemOptions) -> EndoDavSystem:
    """The system of published weights.

    Raises:
        CheckpointError: If the file does not hold exactly EndoDAV in one of its option sets.
        SettingsError: If an option other than ``device`` is set.
    """
    refuse_options(name, options, takes=("device",))
    file = path / "depth_model.pth" if path.is_dir() else path
    network = load_endodav(file).to(options.device)
    return endodav_system(network, name=name, sha256=hash_file(file).sha256)


def endodav_system(network: EndoDav, *, name: str, sha256: str | None = None) -> EndoDavSystem:
    """A loaded network as a system.

    A frame is resized (bicubic) to the smallest size of its aspect that covers the network's, which the network then
    squeezes to its own; disparity goes back to the size of the frame (bilinear, corners aligned), is stitched there,
    and becomes depth last.
    """
    settings = network.settings
    device = next(network.parameters()).device

    def prepare(image: NDArray[np.uint8]) -> F32:
        return to_network(image, covering_size(image.shape[:2], settings.image_size, settings.network.patch_size))

    @torch.inference_mode()
    def predict(images: F32) -> F32:
        disparity = network.disparity(torch.from_numpy(images).to(device)[None])[0]
        return np.asarray(disparity.float().cpu().numpy(), np.float32)

    height, width = settings.image_size
    info = SystemInfo(
        name=name,
        quantity="disparity",
        scale="relative",
        weights_sha256=sha256,
        licence="MIT",
        details={
            "options": describe(settings),
            "input_size": f"{height}x{width}",
            "window": WINDOWS.length,
            "overlap": WINDOWS.overlap,
        },
    )
    return EndoDavSystem(WindowedVideoSystem(info, WINDOWS, prepare, predict), settings.depth_range)


@dataclass(frozen=True)
class EndoDavSystem:
    """Depth from the stitched disparity of a window system."""

    disparities: WindowedVideoSystem
    depth_range: DepthRange

    @property
    def info(self) -> SystemInfo:
        """Relative depth, no cameras."""
        return self.disparities.info.model_copy(update={"quantity": "depth"})

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`; intrinsics are of no use to it."""
        for frame in self.disparities.estimate(frames, intrinsics):
            yield replace(frame, values=self.depth_range.depth(frame.values))

"""The video networks as what an export needs of them: two stages, and what a runtime must know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor, nn

from bathyscope.model_spec import ResizeSpec, VideoSpec
from bathyscope_train.systems.endodac.loading import load_networks
from bathyscope_train.systems.endodac.settings import PATCH
from bathyscope_train.systems.endodav.loading import load_endodav
from bathyscope_train.systems.endodav.system import WINDOWS
from bathyscope_train.systems.vda.system import INPUT_SIZE, is_metric, licence_of, load_vda, windows_of


class TwoStages(Protocol):
    """A network that can be run in two stages, the second in chunks of frames."""

    def mixed(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames (t, 3, h, w) of one window, in [0, 1], to three maps (t, c, h', w') each."""
        ...

    def finish(self, path3: Tensor, level2: Tensor, level1: Tensor) -> Tensor:
        """The three maps of any number of frames to values (n, h, w), never negative."""
        ...


@dataclass(frozen=True, slots=True)
class VideoNetwork:
    """A loaded network, ready to be exported."""

    name: str
    """Its kind: ``vda-s``."""
    network: nn.Module
    """In evaluation mode, without adapters; its ``mixed`` and ``finish`` are those of :class:`TwoStages`."""
    spec: VideoSpec
    patch: int
    follows_input: bool
    """Whether the values are of the size of the input; else the network resizes it to a size of its own."""
    licence: str
    research_only: bool


def vda_network(path: Path, name: str) -> VideoNetwork:
    """Video Depth Anything."""
    network = load_vda(path, name)
    metric = is_metric(name)
    return VideoNetwork(
        name=name,
        network=network,
        spec=VideoSpec(
            quantity="depth" if metric else "disparity",
            scale="metric" if metric else "affine",
            unit="m" if metric else None,
            resize=ResizeSpec(least=(INPUT_SIZE, INPUT_SIZE), lower_long=True),
            windows=windows_of(network, metric=metric),
        ),
        patch=network.settings.patch_size,
        follows_input=True,
        licence=licence_of(name),
        research_only=licence_of(name) != "Apache-2.0",
    )


def endodac_network(path: Path, name: str) -> VideoNetwork:
    """EndoDAC's depth network, its adapters merged; frame by frame."""
    network = load_networks(path).depth.merge().eval()
    settings = network.settings
    return VideoNetwork(
        name=name,
        network=network,
        spec=VideoSpec(
            quantity="depth",
            scale="relative",
            resize=ResizeSpec(least=settings.image_size, back="centres"),
            windows=None,
            depth_range=settings.depth_range,
        ),
        patch=PATCH,
        follows_input=False,
        licence="not stated",
        research_only=True,
    )


def endodav_network(path: Path, name: str) -> VideoNetwork:
    """EndoDAV, its adapters merged."""
    file = path / "depth_model.pth" if path.is_dir() else path
    network = load_endodav(file).merge().eval()
    settings = network.settings
    return VideoNetwork(
        name=name,
        network=network,
        spec=VideoSpec(
            quantity="depth",
            scale="relative",
            resize=ResizeSpec(least=settings.image_size),
            windows=WINDOWS,
            depth_range=settings.depth_range,
        ),
        patch=settings.network.patch_size,
        follows_input=False,
        licence="MIT",
        research_only=False,
    )

"""Video Depth Anything as a system."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bathyscope.bundle import hash_file
from bathyscope.errors import SettingsError
from bathyscope.keyed_windows import KeyedWindows
from bathyscope.vision.shorter_side import network_size, to_network
from bathyscope_train.model.weight_files import open_weights
from bathyscope_train.systems.loading import load_exactly
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import F32, SystemInfo, SystemOptions
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.settings import SIZES
from bathyscope_train.systems.windowed_video import WindowedVideoSystem

INPUT_SIZE = 518
"""Shorter side that the published programs resize to."""
_METRIC = "-metric"


def open_vda(path: Path, name: str, options: SystemOptions) -> WindowedVideoSystem:
    """The system of published weights.

    Args:
        path: The checkpoint.
        name: ``vda-s``, ``vda-b`` or ``vda-l``, with ``-metric`` for the metric weights.
        options: ``input_size`` and ``device`` apply.

    Raises:
        CheckpointError: If the file does not hold exactly this network.
        SettingsError: If another option is set.
    """
    refuse_options(name, options, takes=("input_size", "device"))
    network = load_vda(path, name)
    return vda_system(
        network.to(options.device),
        name=name,
        metric=is_metric(name),
        input_size=options.input_size or INPUT_SIZE,
        sha256=hash_file(path).sha256,
        licence=licence_of(name),
    )


def load_vda(path: Path, name: str) -> VideoDepthAnything:
    """The network ``name`` with published weights, in evaluation mode."""
    letter = _letter(name)
    weights = open_weights(path)
    network = VideoDepthAnything(SIZES[letter])
    load_exactly(network, weights, f"checkpoint of Video Depth Anything, ViT-{letter.upper()}")
    return network.eval()


def is_metric(name: str) -> bool:
    """Whether ``vda-s``, ``vda-s-metric`` ... stands for metric weights."""
    return name.endswith(_METRIC)


def licence_of(name: str) -> str:
    """Licence of the published weights."""
    return "Apache-2.0" if _letter(name) == "s" else "CC-BY-NC-4.0"


def windows_of(network: VideoDepthAnything, *, metric: bool) -> KeyedWindows:
    """The published windows; metric values are not rescaled from one to the next.

    Raises:
        SettingsError: If the network's position table is shorter than a window.
    """
    rule = KeyedWindows(fit="none" if metric else "references")
    if network.settings.frames < rule.length:
        raise SettingsError(
            f"windows have {rule.length} frames, the network knows places for {network.settings.frames}"
        )
    return rule


def _letter(name: str) -> str:
    return name.removeprefix("vda-").removesuffix(_METRIC)


def vda_system(
    network: VideoDepthAnything,
    *,
    name: str,
    metric: bool,
    input_size: int = INPUT_SIZE,
    sha256: str | None = None,
    licence: str | None = None,
) -> WindowedVideoSystem:
    """A loaded network as a system; metric ones give depth in metres, relative ones disparity up to scale and shift."""
    rule = windows_of(network, metric=metric)
    device = next(network.parameters()).device

    def prepare(image: NDArray[np.uint8]) -> F32:
        height, width = image.shape[:2]
        return to_network(image, network_size((height, width), input_size, network.settings.patch_size))

    @torch.inference_mode()
    def predict(images: F32) -> F32:
        values = network(torch.from_numpy(images).to(device)[None])[0]
        return np.asarray(values.float().cpu().numpy(), np.float32)

    return WindowedVideoSystem(
        info=SystemInfo(
            name=name,
            quantity="depth" if metric else "disparity",
            scale="metric" if metric else "affine",
            unit="m" if metric else None,
            weights_sha256=sha256,
            licence=licence,
            details={"input_size": input_size, "window": rule.length, "overlap": rule.overlap},
        ),
        rule=rule,
        prepare=prepare,
        predict=predict,
    )

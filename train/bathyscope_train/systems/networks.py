"""Our network with anybody's weights as a system: AnySplat, VGGT, and checkpoints of our own.

The engine that serves bundles runs it: the same field of view, windows, splatting and stitching, with the network in
PyTorch instead of exported graphs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bathyscope.bundle import hash_file
from bathyscope.engines import ModelInMemory, engine_factory, keep_going
from bathyscope.errors import CheckpointError, SettingsError
from bathyscope.model_spec import InputSpec
from bathyscope.scene import WindowMaps
from bathyscope_train.model.checkpoints import load_network
from bathyscope_train.model.network import Features, Network
from bathyscope_train.model.presets import get_preset
from bathyscope_train.model.specs import network_spec
from bathyscope_train.systems.engine_system import EngineSystem, describe
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import F32, SystemOptions

_SIDES = {"vit": 448, "conv": 125}
"""Root of the area that a network is fed, by the kind of its stem: as AnySplat was trained, and as ours was."""
_WINDOWS = {"vit": (16, 4), "conv": (8, 2)}
"""Frames of a window, and how many neighbouring windows share."""
_VGGT_SIDE = 450
"""Root of 518 x 392, VGGT's input for a picture of 4:3."""


def open_published(path: Path, name: str, preset: str, options: SystemOptions) -> EngineSystem:
    """AnySplat's or VGGT's weights.

    Args:
        path: The file.
        name: What tables call it.
        preset: Built-in preset to load it into.
        options: All apply; ``input_size`` is the root of the area that the network sees.

    Raises:
        CheckpointError: If the file does not fill the network.
        SettingsError: If depth is asked for that the network cannot give.
    """
    network, report = load_network(path, get_preset(preset))
    if not report.complete:
        raise CheckpointError(f"{path}: does not fill the {preset!r} network: {report}")
    return network_system(network, path, name, options)


def open_own(path: Path, name: str, options: SystemOptions) -> EngineSystem:
    """A checkpoint that says itself which network it holds; see :func:`open_published`."""
    network, _ = load_network(path)
    return network_system(network, path, name, options)


def network_system(network: Network, path: Path, name: str, options: SystemOptions) -> EngineSystem:
    """A loaded network as a system; ``path`` is where its weights came from."""
    refuse_options(name, options, takes=("depth", "device", "input_size"))
    preset = network.preset
    if preset.gaussians is None and options.depth == "accumulated":
        raise SettingsError(f"{name} has no Gaussians to accumulate; it has 'head' depth only")
    digest = hash_file(path).sha256
    wanted = _input(network, options)
    spec = network_spec(preset, name=name, version=digest[:12], wanted=wanted, licence="as its weights")
    model = ModelInMemory(spec, digest, TorchModel(network.to(options.device)))
    return EngineSystem(engine_factory()(model), describe(spec, name, digest, options), options)


@dataclass(frozen=True)
class TorchModel:
    """A network in PyTorch as a :class:`~bathyscope.engines.WindowModel`."""

    network: Network
    chunk: int = 4
    """Frames that the dense heads run on at once."""

    @torch.inference_mode()
    def predict(
        self, images: F32, checkpoint: Callable[[], None] = keep_going, *, focal: float | None = None
    ) -> WindowMaps:
        """See :class:`~bathyscope.engines.WindowModel`."""
        network = self.network
        clip = torch.from_numpy(np.ascontiguousarray(images)).to(next(network.parameters()).device)[None]
        features = network.encode(clip)
        parts = []
        for start in range(0, len(images), self.chunk):
            checkpoint()
            frames = slice(start, start + self.chunk)
            parts.append(network.dense(_of_frames(features, frames), clip[:, frames]))
        checkpoint()
        known = None if focal is None else clip.new_tensor([focal])
        solved = network.cameras(features, torch.cat([part.depth for part in parts], 1), known)
        gaussians = [part.gaussians for part in parts if part.gaussians is not None]
        return WindowMaps(
            depth=_array(solved.depth[0]),
            confidence=_array(torch.cat([part.confidence for part in parts], 1)[0]),
            gaussians=_array(torch.cat(gaussians, 1)[0]) if gaussians else None,
            pose_encoding=_array(solved.pose_encodings[-1, 0]),
        )


def _of_frames(features: Features, frames: slice) -> Features:
    return Features(
        taps=tuple(tap[:, frames] for tap in features.taps),
        camera=features.camera[:, frames],
        stem_maps=tuple(maps[:, frames] for maps in features.stem_maps),
    )


def _array(values: Tensor) -> F32:
    return np.asarray(values.float().cpu().numpy(), np.float32)


def _input(network: Network, options: SystemOptions) -> InputSpec:
    preset = network.preset
    window, overlap = _WINDOWS[preset.stem.kind]
    side = options.input_size or (_VGGT_SIDE if preset.name == "vggt" else _SIDES[preset.stem.kind])
    return InputSpec(patch=preset.patch_size, pixels=side * side, window=window, overlap=overlap)

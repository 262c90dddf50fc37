"""The kinds of system that are opened from published weights, and how each is told by the names of its tensors.

Recognising needs neither torch nor network: a few keys and shapes that no other kind has. Loading then compares
every key.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bathyscope_train.systems.system import System, SystemOptions

if TYPE_CHECKING:
    from bathyscope_train.systems.video_networks import VideoNetwork

Shapes = Mapping[str, tuple[int, ...]]
"""Shape of every tensor of a file, by its name without the wrappers ``module.`` and ``model.``."""

_WRAPPERS = ("module.", "model.")
_DEPTH_FILE = "depth_model.pth"
_ENDODAC_WEIGHTS = (
    f"{_DEPTH_FILE} of BeileiCui/EndoDAC, or its folder with pose_encoder.pth, pose.pth, intrinsics_head.pth"
)


@dataclass(frozen=True, slots=True)
class Kind:
    """One published network."""

    name: str
    """What the user calls it: ``vda-s``."""
    weights: str
    """What is to be had where, and under which licence; said when the weights are not at hand."""
    recognises: Callable[[Shapes], bool]
    """Whether a file with these tensors is of this kind."""
    open: Callable[[Path, Kind, SystemOptions], System]
    """Load it. Raises CheckpointError if the file does not hold exactly the network."""
    member: str | None = None
    """The file by which a folder of weights is recognised, for networks that are published as several files."""
    preset: str | None = None
    """The built-in preset that the weights fill, where there is one."""
    video: Callable[[Path, str], VideoNetwork] | None = None
    """Load it for an export, where it is a video network."""


def bare(key: str) -> str:
    """A key without the wrappers that training programs put before it."""
    while (wrapper := next((each for each in _WRAPPERS if key.startswith(each)), None)) is not None:
        key = key.removeprefix(wrapper)
    return key


def has(shapes: Shapes, key: str, *sides: int | None) -> bool:
    """Whether there is a tensor of this name and shape; ``None`` stands for any side."""
    found = shapes.get(key)
    return (
        found is not None
        and len(found) == len(sides)
        and all(b in (None, a) for a, b in zip(found, sides, strict=True))
    )


def _is_anysplat(shapes: Shapes) -> bool:
    return _has_aggregator(shapes) and _has_gaussian_head(shapes)


def _is_vggt(shapes: Shapes) -> bool:
    return _has_aggregator(shapes) and not _has_gaussian_head(shapes)


def _has_aggregator(shapes: Shapes) -> bool:
    return any(has(shapes, f"{prefix}aggregator.camera_token", 1, 2, 1, 1024) for prefix in ("", "encoder."))


def _has_gaussian_head(shapes: Shapes) -> bool:
    return any("gaussian_param_head." in key for key in shapes)


def _is_vda(width: int) -> Callable[[Shapes], bool]:
    def recognises(shapes: Shapes) -> bool:
        return (
            has(shapes, "pretrained.pos_embed", 1, None, width)
            and any(key.startswith("head.motion_modules.") for key in shapes)
            and any(key.startswith("head.scratch.output_conv2.") for key in shapes)
            and not any("lora_" in key or ".residual_." in key for key in shapes)
        )

    return recognises


def _is_endodac(width: int) -> Callable[[Shapes], bool]:
    def recognises(shapes: Shapes) -> bool:
        return has(shapes, "encoder.pos_embed", 1, None, width) and any(
            key.startswith("depth_head.conv_depth_") for key in shapes
        )

    return recognises


def _is_endodav(shapes: Shapes) -> bool:
    """Video Depth Anything with anything that it has not: adapters, a neck, sigmoid heads."""
    return (
        has(shapes, "pretrained.pos_embed", 1, None, None)
        and any(key.startswith("head.motion_modules.") for key in shapes)
        and any("lora_" in key or ".residual_." in key or "head.conv_depth_" in key for key in shapes)
    )


def _open_network(path: Path, kind: Kind, options: SystemOptions) -> System:
    from bathyscope_train.systems.networks import open_published

    assert kind.preset is not None
    return open_published(path, kind.name, kind.preset, options)


def _open_vda(path: Path, kind: Kind, options: SystemOptions) -> System:
    from bathyscope_train.systems.vda.system import open_vda

    return open_vda(path, kind.name, options)


def _open_endodac(path: Path, kind: Kind, options: SystemOptions) -> System:
    from bathyscope_train.systems.endodac.system import open_endodac

    return open_endodac(path, kind.name, options)


def _open_endodav(path: Path, kind: Kind, options: SystemOptions) -> System:
    from bathyscope_train.systems.endodav.system import open_endodav

    return open_endodav(path, kind.name, options)


def _vda_video(path: Path, name: str) -> VideoNetwork:
    from bathyscope_train.systems.video_networks import vda_network

    return vda_network(path, name)


def _endodac_video(path: Path, name: str) -> VideoNetwork:
    from bathyscope_train.systems.video_networks import endodac_network

    return endodac_network(path, name)


def _endodav_video(path: Path, name: str) -> VideoNetwork:
    from bathyscope_train.systems.video_networks import endodav_network

    return endodav_network(path, name)


def _vda(letter: str, width: int, licence: str) -> tuple[Kind, Kind]:
    file = f"video_depth_anything_vit{letter}.pth"
    recognises = _is_vda(width)
    return (
        Kind(f"vda-{letter}", f"{file} of Video Depth Anything, {licence}", recognises, _open_vda, video=_vda_video),
        Kind(
            f"vda-{letter}-metric",
            f"metric_{file} of Video Depth Anything, {licence}",
            recognises,
            _open_vda,
            video=_vda_video,
        ),
    )


KINDS: tuple[Kind, ...] = (
    Kind("anysplat", "model.safetensors of lhjiang/anysplat", _is_anysplat, _open_network, preset="anysplat"),
    Kind("vggt", "model.safetensors of facebook/VGGT-1B", _is_vggt, _open_network, preset="vggt"),
    *_vda("s", 384, "Apache-2.0"),
    *_vda("b", 768, "CC-BY-NC-4.0"),
    *_vda("l", 1024, "CC-BY-NC-4.0"),
    Kind("endodac", _ENDODAC_WEIGHTS, _is_endodac(768), _open_endodac, _DEPTH_FILE, video=_endodac_video),
    Kind(
        "endodac-s",
        f"{_ENDODAC_WEIGHTS}, trained on ViT-S",
        _is_endodac(384),
        _open_endodac,
        _DEPTH_FILE,
        video=_endodac_video,
    ),
    Kind("endodav", f"{_DEPTH_FILE} of Zanue/EndoDAV", _is_endodav, _open_endodav, _DEPTH_FILE, video=_endodav_video),
)
"""Every kind. Of two that read the same tensors the first is meant, unless the user or the file's name says more."""

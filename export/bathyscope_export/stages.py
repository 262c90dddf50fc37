"""A network cut into the three graphs of a bundle, as modules with named inputs and outputs.

``backbone`` sees a whole clip; ``heads`` work frame by frame, so that a runtime can feed them a few frames at a
time; ``cameras`` see the clip again, but only what they need of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from bathyscope.bundle import Role
from bathyscope_train.model.network import Features, Network

_FRAMES, _ROWS, _COLUMNS = 4, 8, 10


@dataclass(frozen=True, slots=True)
class Stage:
    """One part of a network, ready to be traced."""

    role: Role
    module: nn.Module
    arguments: tuple[Tensor, ...]
    """Example inputs; their sizes all differ, so that none is mistaken for another or for a constant."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    shapes: tuple[dict[int, Any], ...] | None = None
    """Dynamic axes of each argument, as ``torch.export`` takes them; those that its name implies unless given."""


def split(network: Network) -> tuple[Stage, ...]:
    """Backbone, heads and cameras of a network; the heads give Gaussians where the network has any."""
    patch = network.preset.patch_size
    images = torch.rand(_FRAMES, 3, patch * _ROWS, patch * _COLUMNS, generator=torch.Generator().manual_seed(0))
    backbone = Backbone(network)
    with torch.no_grad():
        features = backbone(images)
    taps = len(network.preset.aggregator.taps)
    tokens = tuple(f"tokens_{index}" for index in range(taps))
    stem = tuple(f"stem_{index}" for index in range(len(features) - taps - 1))
    named = dict(zip((*tokens, "camera", *stem), features, strict=True))
    return (
        Stage("backbone", backbone, (images,), ("images",), tuple(named)),
        Stage(
            "heads",
            Heads(network),
            (images, *(named[name] for name in (*tokens, *stem))),
            ("images", *tokens, *stem),
            ("depth", "confidence") if network.gaussian_param_head is None else ("depth", "confidence", "gaussians"),
        ),
        _camera_stage(network, named, torch.ones(_FRAMES, *images.shape[-2:])),
    )


def _camera_stage(network: Network, named: Mapping[str, Tensor], depth: Tensor) -> Stage:
    """Only what the camera head reads: an input that is traced and not read would still be asked for."""
    if network.preset.camera.kind == "iterative":
        return Stage("cameras", TokenCameras(network), (named["camera"],), ("camera",), ("pose_encoding",))
    tokens = max(name for name in named if name.startswith("tokens_"))
    stem = max(name for name in named if name.startswith("stem_"))
    return Stage(
        "cameras",
        MatchingCameras(network, halvings=1 + int(stem.removeprefix("stem_"))),
        (depth, *(named[name] for name in ("camera", tokens, stem)), torch.zeros(1)),
        ("depth", "camera", tokens, stem, "focal"),
        ("pose_encoding", "refined_depth"),
    )


class Backbone(nn.Module):
    """Images (t, 3, h, w) to tokens (t, rows, columns, c) of each tap, camera tokens (t, c) and stem maps."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        patch = self.network.preset.patch_size
        grid = (images.shape[2] // patch, images.shape[3] // patch)
        features = self.network.encode(images[None])
        tokens = [each[0].unflatten(1, grid) for each in features.taps]
        return (*tokens, features.camera[0], *(each[0] for each in features.stem_maps))


class Heads(nn.Module):
    """Images, tokens and stem maps to depth and confidence (t, h, w) and, if there are any, Gaussians (t, g, h, w)."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor, *features: Tensor) -> tuple[Tensor, ...]:
        taps = len(self.network.preset.aggregator.taps)
        known = Features(
            taps=tuple(tokens.flatten(1, 2)[None] for tokens in features[:taps]),
            camera=features[0][None, :, 0, 0],
            stem_maps=tuple(
                _cut(maps, images.shape[-2:], halvings=index + 1) for index, maps in enumerate(features[taps:])
            ),
        )
        maps = self.network.dense(known, images[None])
        gaussians = () if maps.gaussians is None else (maps.gaussians[0],)
        return maps.depth[0], maps.confidence[0], *gaussians


class TokenCameras(nn.Module):
    """Camera tokens (t, c) to pose encodings (t, 9), for the iterative head."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, camera: Tensor) -> Tensor:
        known = Features(taps=(), camera=camera[None])
        return self.network.cameras(known, camera.new_ones(())).pose_encodings[-1, 0]


class MatchingCameras(nn.Module):
    """Depth, camera tokens, the last tokens and the last stem map to pose encodings (t, 9) and refined depth (t, h, w).

    For the matching head. ``focal`` (1,) is the focal length in pixels where it is known, else 0.

    Args:
        network: The network.
        halvings: How often the image was halved (and rounded up) to the size of the stem map.
    """

    def __init__(self, network: Network, *, halvings: int) -> None:
        super().__init__()
        self.network = network
        self.halvings = halvings

    def forward(
        self, depth: Tensor, camera: Tensor, tokens: Tensor, stem: Tensor, focal: Tensor
    ) -> tuple[Tensor, Tensor]:
        known = Features(
            taps=(tokens.flatten(1, 2)[None],),
            camera=camera[None],
            stem_maps=(_cut(stem, depth.shape[-2:], halvings=self.halvings),),
        )
        solved = self.network.cameras(known, depth[None], focal)
        return solved.pose_encodings[-1, 0], solved.depth[0]


def _cut(maps: Tensor, size: Sequence[int], *, halvings: int) -> Tensor:
    """The stem map, cut to the size it has anyway, which tells the tracer how it depends on the image's."""
    height, width = size
    for _ in range(halvings):
        height, width = (height + 1) // 2, (width + 1) // 2
    return maps[None, :, :, :height, :width]

"""Write the bundle of a video network: two graphs, weights, model card and manifest."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bathyscope.bundle import ROLES, Bundle, BundleManifest, GraphSpec, Role, hash_file, write_manifest
from bathyscope.errors import BundleError
from bathyscope.model_spec import InputSpec
from bathyscope_export.card import items
from bathyscope_export.parity import run_graphs, sample_clip, spread, start
from bathyscope_export.video_stages import split_video
from bathyscope_export.writer import CARD, WEIGHTS, placed, strip_paths, write_stages
from bathyscope_train.systems.video_networks import TwoStages, VideoNetwork

MAX_DIFFERENCE = 1e-4
"""Of the values' standard deviation: what rounding explains."""
_GRIDS = ((1, 6, 8), (2, 5, 4), (5, 4, 6))
"""Frames, rows and columns of patches on which graphs and network are compared."""


@dataclass(frozen=True, slots=True)
class VideoBundleSettings:
    """What a video bundle says about itself, besides what its network says."""

    name: str
    version: str
    weights_sha256: str | None
    """Of the checkpoint that it was made from; None for a guess, which has none."""
    accuracy: Mapping[str, Any]
    """Measured accuracy, with protocol."""


@dataclass(frozen=True, slots=True)
class ValueDifference:
    """How far the graphs are from PyTorch for one window."""

    frames: int
    height: int
    width: int
    values: float
    """Largest difference over the standard deviation of the values."""

    def check(self) -> None:
        """Refuse differences that rounding does not explain.

        Raises:
            BundleError: If values are off by more than 1e-4 of their standard deviation.
        """
        if not self.values <= MAX_DIFFERENCE:
            raise BundleError(
                f"the exported graphs differ from PyTorch on {self.frames} frames of {self.height}x{self.width}: "
                f"{self.values:.1e} of the values' standard deviation (at most {MAX_DIFFERENCE:.0e})"
            )


def write_video_bundle(
    video: VideoNetwork,
    folder: Path,
    settings: VideoBundleSettings,
    *,
    replace: bool = False,
    progress: Callable[[str], None] = lambda message: None,
) -> Bundle:
    """Export a video network into a new folder; written beside and renamed into place.

    Args:
        video: On the CPU, in float32.
        folder: Where the bundle goes.
        settings: What it says about itself.
        replace: Whether a bundle that lies there already may go.
        progress: Told what is being done; the whole takes minutes.

    Raises:
        BundleError: If the folder exists, the graphs differ from PyTorch, or their attention is quadratic in memory.
    """
    return placed(folder, lambda beside: _fill(video, beside, settings, progress), replace=replace)


def _fill(video: VideoNetwork, folder: Path, settings: VideoBundleSettings, progress: Callable[[str], None]) -> None:
    graphs = write_stages(split_video(video), folder, patch=video.patch, progress=progress)
    progress("comparing with PyTorch")
    differences = compare_video(video, folder, graphs)
    for difference in differences:
        difference.check()
    parity = [asdict(difference) for difference in differences]
    accuracy = strip_paths(dict(settings.accuracy))
    _write_card(folder / CARD, video, settings, parity, accuracy)
    windows, least = video.spec.windows, video.spec.resize.least
    manifest = BundleManifest(
        name=settings.name,
        version=settings.version,
        preset=video.name,
        kind="video",
        graphs=graphs,
        weights=WEIGHTS,
        files={name: hash_file(folder / name) for name in (*(graph.file for graph in graphs.values()), WEIGHTS, CARD)},
        input=InputSpec(
            patch=video.patch,
            pixels=least[0] * least[1],
            window=1 if windows is None else windows.length,
            overlap=0 if windows is None else windows.overlap,
        ),
        video=video.spec,
        licence=video.licence,
        research_only=video.research_only,
        training={"weights_sha256": settings.weights_sha256},
        parity=parity,
        accuracy=accuracy,
    )
    write_manifest(folder, manifest)


def compare_video(video: VideoNetwork, folder: Path, graphs: Mapping[Role, GraphSpec]) -> list[ValueDifference]:
    """Differences for windows of several lengths and sizes, among them the longest and that of the position table."""
    sessions = {role: start(folder / graph.file) for role, graph in graphs.items()}
    windows = video.spec.windows
    longest = () if windows is None else ((windows.length, 4, 5),)
    network: TwoStages = video.network  # type: ignore[assignment]
    differences = []
    for frames, rows, columns in (*_GRIDS, *longest, *_own_grid(video)):
        images = sample_clip(frames, video.patch * rows, video.patch * columns)
        with torch.no_grad():
            expected = network.finish(*network.mixed(images))
        observed = run_graphs(sessions, graphs, images.numpy(), ROLES["video"])["values"]
        height, width = images.shape[-2:]
        differences.append(ValueDifference(frames, height, width, spread(expected, np.asarray(observed))))
    return differences


def _own_grid(video: VideoNetwork) -> tuple[tuple[int, int, int], ...]:
    """One frame at the size of the learnt position table, which is not resampled there."""
    encoder = getattr(video.network, "pretrained", None)
    if not video.follows_input or encoder is None:
        return ()
    return ((1, encoder.grid, encoder.grid),)


def _write_card(
    path: Path,
    video: VideoNetwork,
    settings: VideoBundleSettings,
    parity: list[dict[str, Any]],
    accuracy: Mapping[str, Any],
) -> None:
    spec = video.spec
    unit = "" if spec.unit is None else f" in {spec.unit}"
    windows = "frame by frame" if spec.windows is None else f"in windows of {spec.windows.length} frames"
    lines = [
        f"# {settings.name} {settings.version}",
        "",
        f"{spec.quantity.capitalize()} ({spec.scale}{unit}) of a video, {windows}; network {video.name!r}.",
        "No cameras, no confidence, no scene. Not a medical device.",
        "",
        f"* Licence of the weights: {video.licence}" + ("; for research only" if video.research_only else ""),
        f"* SHA-256 of the checkpoint: {settings.weights_sha256 or 'there is none'}",
        f"* Largest difference from PyTorch: {max(record['values'] for record in parity):.1e} of the values' "
        "standard deviation",
        "",
        "## Accuracy",
        "",
        *items(accuracy),
        "",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")

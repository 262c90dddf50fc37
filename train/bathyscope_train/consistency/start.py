"""What a run begins with: the network of a checkpoint, and windows of videos."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from bathyscope.errors import CheckpointError
from bathyscope_train.consistency.rendered_clips import is_rendered, rendered_videos
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.data.clip_sources import OpenedSources, open_sources
from bathyscope_train.data.clip_windows import ClipWindows
from bathyscope_train.model.checkpoints import load_network, names_its_network
from bathyscope_train.model.network import Network
from bathyscope_train.model.presets import get_preset
from bathyscope_train.model.weight_files import open_weights
from bathyscope_train.systems.kinds import Kind
from bathyscope_train.systems.recognition import kind_called, recognise

SURVEY_FOLDER = "survey"
_HEADS_THAT_MAY_BE_NEW = ("gaussian_param_head.",)

_log = logging.getLogger(__name__)


def load_initial(path: Path, preset: str | None) -> Network:
    """The network of the checkpoint that training starts from.

    Args:
        path: One of ours, which says its preset, or published weights.
        preset: Built-in preset: needed for published weights, and compared with what one of ours says.

    Raises:
        CheckpointError: If the file cannot be used, is of another preset, or does not fill the network. The Gaussian
            head alone may be missing from published weights (VGGT has none); it then starts from noise, and says so.
    """
    weights = open_weights(path)
    if names_its_network(weights):
        network, _ = load_network(path)
        if preset is not None and network.preset.name != preset:
            raise CheckpointError(
                f"{path}: holds the {network.preset.name!r} network, the settings ask for {preset!r}; "
                f"give a checkpoint of {preset!r}, or preset={network.preset.name}"
            )
        return network
    if preset is None:
        raise CheckpointError(f"{path}: does not say which network it belongs to; add preset=NAME, as preset=anysplat")
    network, report = load_network(path, get_preset(preset))
    lost = [name for name in report.missing if not name.startswith(_HEADS_THAT_MAY_BE_NEW)]
    if lost or report.mismatched:
        raise CheckpointError(f"{path}: does not fill the {preset!r} network: {report}")
    if report.missing:
        _log.warning("%s: has no Gaussian head; it starts from noise (%s)", path, report)
    return network


def video_kind(path: Path, preset: str | None) -> Kind | None:
    """The kind of Video Depth Anything that a file holds; ``None`` for every other network.

    Raises:
        CheckpointError: If the file cannot be used, or does not hold the kind that is asked for.
    """
    wanted = kind_called(preset)
    if preset is not None and wanted is None:
        return None
    kind = recognise(path, wanted) if wanted is not None else _recognised(path)
    return kind if kind is not None and kind.name.startswith("vda-") else None


def _recognised(path: Path) -> Kind | None:
    """The kind of published weights; ``None`` for what is told in other ways, or not at all."""
    try:
        return recognise(path)
    except CheckpointError:
        return None


def open_videos_of(settings: ConsistencySettings) -> OpenedSources:
    """The videos of all sources, folders of rendered clips among them.

    Raises:
        DatasetError: If a folder holds nothing that can be used.
    """
    rendered = [source for source in settings.data if is_rendered(source.folder)]
    others = [source for source in settings.data if source not in rendered]
    opened = open_sources(others) if others else OpenedSources((), (), ())
    sequences, shares, notes = list(opened.sequences), list(opened.shares), list(opened.notes)
    for source in rendered:
        found, said = rendered_videos(source.folder)
        sequences += found
        shares += [source.share] * len(found)
        notes += said
    return OpenedSources(tuple(sequences), tuple(shares), tuple(notes))


def open_training_windows(settings: ConsistencySettings) -> ClipWindows:
    """Windows to train on, after a first pass over all videos, which is kept for the next run.

    What cannot be used is left out, and named in the notes.

    Raises:
        DatasetError: If no video holds a window; says why.
    """
    opened = open_videos_of(settings)
    windows = ClipWindows.survey(
        opened.sequences,
        settings.window,
        seed=settings.seed,
        shares=opened.shares,
        cache=settings.cache or settings.out / SURVEY_FOLDER,
    )
    return replace(windows, notes=opened.notes + windows.notes)

"""``--dry-run``: what a run would do, without doing it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import yaml

from bathyscope.errors import DatasetError
from bathyscope.vision.grid import choose_size
from bathyscope_train.consistency.clip_step import check_objective
from bathyscope_train.consistency.memory import Memory, expected_memory
from bathyscope_train.consistency.parts import Group, trained_groups
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.consistency.start import load_initial, open_videos_of, video_kind
from bathyscope_train.consistency.video_memory import expected_video_memory
from bathyscope_train.consistency.video_run import check_video_settings
from bathyscope_train.data.datasets.sequence import DataSequence
from bathyscope_train.model.network import Network
from bathyscope_train.systems.vda.network import VideoDepthAnything
from bathyscope_train.systems.vda.system import is_metric, load_vda

_NAMED = 5


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run would do."""

    settings: ConsistencySettings
    preset: str
    groups: tuple[Group, ...]
    counts: tuple[int, ...]
    """Parameters of each group."""
    frozen: int
    videos: int
    frames: int
    notes: tuple[str, ...]
    """What of the data cannot be used."""
    size: tuple[int, int]
    memory: Memory

    def __str__(self) -> str:
        mib = 1 << 20
        rows = [
            f"  {group.part:22}{count:>12,}  rate x{group.settings.rate:g}"
            f"{', after the warm-up' if group.settings.after_warmup else ''}"
            f"{f', weight decay {self.settings.weight_decay:g}' if group.decayed else ''}"
            for group, count in zip(self.groups, self.counts, strict=True)
        ]
        sizes = [f"  {name:22}{count / mib:>12,.1f} MiB" for name, count in self.memory.parts.items()]
        notes = [f"  {note}" for note in self.notes[:_NAMED]]
        more = [f"  ... and {len(self.notes) - _NAMED} more"] if len(self.notes) > _NAMED else []
        return "\n".join(
            [
                "settings",
                *_indented(self.settings),
                f"data: {self.videos} videos, {self.frames:,} frames, seen at {self.size[1]}x{self.size[0]}",
                *notes,
                *more,
                f"parameters of {self.preset!r}",
                *rows,
                f"  {'frozen':22}{self.frozen:>12,}",
                "memory of one process",
                *sizes,
                f"  {'together':22}{self.memory.total / mib:>12,.1f} MiB, and what torch and its kernels take",
            ]
        )


def make_plan(settings: ConsistencySettings, *, processes: int = 1) -> Plan:
    """Read what a run would read, without the first pass over the videos.

    Args:
        settings: Of the run.
        processes: That would share its batches.

    Raises:
        SettingsError: If the network cannot be trained this way.
        CheckpointError: If the initial checkpoint cannot be used.
        DatasetError: If the data holds no video.
    """
    network, name = _initial(settings)
    groups = trained_groups(network, settings.parts)
    opened = open_videos_of(settings)
    numbers = {name: value.numel() for name, value in network.named_parameters()}
    counts = [sum(numbers[name] for name in group.names) for group in groups]
    size = settings.window.size or largest_size(opened.sequences, settings)
    clips = max(settings.batch // (processes * settings.accumulate), 1)
    return Plan(
        settings=settings,
        preset=name,
        groups=tuple(groups),
        counts=tuple(counts),
        frozen=sum(numbers.values()) - sum(counts),
        videos=len(opened.sequences),
        frames=sum(len(sequence) for sequence in opened.sequences),
        notes=opened.notes,
        size=size,
        memory=_memory(network, groups, settings, size, clips),
    )


def _initial(settings: ConsistencySettings) -> tuple[Network | VideoDepthAnything, str]:
    """The network that training starts from, checked, and what it is called."""
    kind = video_kind(settings.init, settings.preset)
    if kind is not None:
        check_video_settings(settings, metric=is_metric(kind.name))
        return load_vda(settings.init, kind.name), kind.name
    network = load_initial(settings.init, settings.preset)
    check_objective(network, settings)
    return network, network.preset.name


def _memory(
    network: Network | VideoDepthAnything,
    groups: list[Group],
    settings: ConsistencySettings,
    size: tuple[int, int],
    clips: int,
) -> Memory:
    if isinstance(network, Network):
        return expected_memory(network.preset, groups, settings, size, clips)
    return expected_video_memory(network.settings, groups, settings, size, clips)


def largest_size(sequences: Sequence[DataSequence], settings: ConsistencySettings) -> tuple[int, int]:
    """The largest size that whole frames of these videos would be seen at."""
    if not sequences:
        raise DatasetError("no videos to train on")
    sizes = [choose_size(each.size, settings.window.patch, settings.window.pixels) for each in sequences]
    height, width = max(sizes, key=lambda size: size[0] * size[1])
    return height, width


def _indented(settings: ConsistencySettings) -> list[str]:
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=110)
    return [f"  {line}" for line in text.splitlines()]

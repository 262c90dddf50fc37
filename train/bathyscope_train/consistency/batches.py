"""Batches on their way into the objective: in parts, and measured once before training to balance its terms."""

import logging
from collections.abc import Iterable, Mapping
from itertools import islice

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.consistency.clip_step import ClipStep
from bathyscope_train.consistency.processes import Processes
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.consistency.video_step import VideoStep
from bathyscope_train.data.clip_loader import FrameBatch
from bathyscope_train.losses.balance import measured_weights

Part = tuple[Float[Tensor, "b t 3 h w"], Bool[Tensor, "b h w"], Float[Tensor, "b"] | None]
"""Images, field of view, and focal lengths in pixels where they are given."""

_log = logging.getLogger(__name__)


def parts_of(batch: FrameBatch, settings: ConsistencySettings, device: torch.device) -> list[Part]:
    """A batch on the device, in as many parts as gradients are accumulated over."""
    count = settings.accumulate
    images, inside = (values.to(device).chunk(count) for values in (batch.images, batch.inside))
    if not settings.known_focal or batch.intrinsics is None:
        return [(images[number], inside[number], None) for number in range(count)]
    focal = batch.intrinsics[:, 0, 0].to(device).chunk(count)
    return list(zip(images, inside, focal, strict=True))


def mean_over(values: Mapping[str, Tensor], processes: Processes) -> dict[str, float]:
    """Numbers of all processes together."""
    names = list(values)
    means = processes.mean(torch.stack([values[name].detach().float() for name in names]))
    return dict(zip(names, means.tolist(), strict=True))


@torch.no_grad()
def balanced_weights(
    step: ClipStep | VideoStep, batches: Iterable[FrameBatch], settings: ConsistencySettings, processes: Processes
) -> dict[str, float]:
    """Factors under which each term, at the size that it has before training, adds the share that its weight says.

    Args:
        step: The objective.
        batches: Of which ``balance_steps`` are measured.
        settings: Of the run; its weights are read as shares.
        processes: All of them take part.

    Raises:
        SettingsError: If a term with a weight measures 0 or is not finite.
    """
    sizes = dict.fromkeys(settings.loss.weights, 0.0)
    count = settings.balance_steps * settings.accumulate
    for batch in islice(batches, settings.balance_steps):
        for images, inside, focal in parts_of(batch, settings, processes.device):
            found = mean_over(step(images, inside, focal), processes)
            sizes = {name: size + found.get(name, 0.0) / count for name, size in sizes.items()}
    sizes["anchor"] = sizes["anchor"] or 1.0  # nothing has moved yet: its weight stays what it is
    weights = measured_weights(sizes, settings.loss.weights)
    if settings.loss.anchor.weight > 0:
        weights["anchor"] = settings.loss.anchor.weight
    _log.info("weights from measured sizes: %s", {name: round(value, 5) for name, value in weights.items()})
    return weights

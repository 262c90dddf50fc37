"""Percentiles of parts of images, and the automatic exposure that is steered by one."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.data.synthetic.optics import _LUMINANCE as LUMINANCE
from bathyscope_train.data.synthetic.optics import Sensor

Clips = Float[Tensor, "b t 3 h w"]


def per_clip(values: Sequence[float], like: Float[Tensor, "b ..."]) -> Tensor:
    """A number a clip, with as many axes as ``like``."""
    return torch.tensor(values, dtype=like.dtype, device=like.device).view(-1, *(1,) * (like.ndim - 1))


def views(sensors: Sequence[Sensor], like: Tensor) -> Float[Tensor, "b 1 1 h w"]:
    """Share of light that each clip's field of view lets through."""
    return torch.from_numpy(np.stack([sensor.view for sensor in sensors])).to(like)[:, None, None]


def masked_percentile(
    values: Float[Tensor, "n m"], mask: Bool[Tensor, "n m"], share: Float[Tensor, "n"] | float
) -> Float[Tensor, "n"]:
    """Of each row the value below which ``share`` of its marked values lie, linear between two; 1 where none is marked.

    Agrees with ``np.percentile`` and, at a half, ``np.median``.
    """
    ordered = torch.where(mask, values, torch.inf).sort(-1).values
    count = mask.sum(-1)
    rank = share * (count - 1).clamp_min(0).to(values.dtype)
    low = rank.long()
    high = torch.minimum(low + 1, (count - 1).clamp_min(0))
    below, above = (ordered.gather(-1, index[:, None])[:, 0] for index in (low, high))
    return torch.where(count > 0, torch.lerp(below, above, rank - low), 1.0)


def metered(radiance: Clips, sensors: Sequence[Sensor]) -> Float[Tensor, "b t"]:
    """Luminance of the metered percentile inside each clip's view."""
    luminance = torch.einsum("c,btchw->bthw", torch.from_numpy(LUMINANCE).to(radiance), radiance).flatten(2)
    inside = (views(sensors, radiance)[:, 0] > 0.5).flatten(2).expand_as(luminance)
    share = per_clip([sensor.metering / 100 for sensor in sensors], luminance[..., 0]).expand_as(luminance[..., 0])
    found = masked_percentile(luminance.flatten(0, 1), inside.flatten(0, 1), share.flatten())
    return found.view(luminance.shape[:2])


def gains(radiance: Clips, sensors: Sequence[Sensor]) -> Float[Tensor, "b t"]:
    """Exposure of every frame: steered by the brightness inside the view, with lag."""
    found = metered(radiance, sensors)
    wanted = per_clip([sensor.exposure**sensor.gamma for sensor in sensors], found) / found.clamp_min(1e-6)
    lag = per_clip([sensor.lag for sensor in sensors], wanted[:, 0])
    result = [wanted[:, 0]]
    for index in range(1, wanted.shape[1]):
        result.append(result[-1] ** lag * wanted[:, index] ** (1 - lag))
    return torch.stack(result, 1)

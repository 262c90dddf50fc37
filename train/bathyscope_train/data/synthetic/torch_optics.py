"""From radiance to the eight bits of a video, in torch: what ``optics`` does, for several clips at once."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from bathyscope_train.data.synthetic.optics import _LUMINANCE, Sensor
from bathyscope_train.data.synthetic.torch_filters import blur
from bathyscope_train.data.synthetic.torch_jpeg import compress

Clips = Float[Tensor, "b t 3 h w"]


def views(sensors: Sequence[Sensor], like: Tensor) -> Float[Tensor, "b 1 1 h w"]:
    """Share of light that each clip's field of view lets through."""
    return torch.from_numpy(np.stack([sensor.view for sensor in sensors])).to(like)[:, None, None]


def gains(radiance: Clips, sensors: Sequence[Sensor]) -> Float[Tensor, "b t"]:
    """Exposure of every frame: steered by the brightness inside the view, with lag."""
    inside = views(sensors, radiance)[:, :, 0] > 0.5
    luminance = torch.einsum("c,btchw->bthw", torch.from_numpy(_LUMINANCE).to(radiance), radiance)
    ordered = torch.where(inside, luminance, torch.inf).flatten(2).sort(-1).values
    ranks = [sensor.metering / 100 * (np.count_nonzero(sensor.view > 0.5) - 1) for sensor in sensors]
    low = torch.tensor([int(rank) for rank in ranks], device=radiance.device).expand(1, -1).T[:, :, None]
    share = torch.tensor([rank % 1 for rank in ranks]).to(radiance)[:, None]
    below, above = (
        ordered.gather(2, index.expand(-1, ordered.shape[1], 1))[..., 0]
        for index in (low, (low + 1).clamp_max(ordered.shape[2] - 1))
    )
    metered = torch.where(share > 0, torch.lerp(below, above, share), below)
    target = torch.tensor([sensor.exposure**sensor.gamma for sensor in sensors]).to(radiance)[:, None]
    wanted = target / metered.clamp_min(1e-6)
    lag = torch.tensor([sensor.lag for sensor in sensors]).to(radiance)
    result = [wanted[:, 0]]
    for index in range(1, wanted.shape[1]):
        result.append(result[-1] ** lag * wanted[:, index] ** (1 - lag))
    return torch.stack(result, 1)


def develop(
    radiance: Clips, sensors: Sequence[Sensor], generator: torch.Generator | None = None
) -> UInt8[Tensor, "b t 3 h w"]:
    """Turn linear radiance into displayed frames.

    Args:
        radiance: What reaches the lens.
        sensors: One camera head a clip.
        generator: Source of the noise, on the radiance's device.
    """

    def column(pick: Callable[[Sensor], float]) -> Float[Tensor, "b 1 1 1 1"]:
        return torch.tensor([pick(sensor) for sensor in sensors]).to(radiance)[:, None, None, None, None]

    window = views(sensors, radiance) * (1 - column(lambda one: one.vignette) * _corner(radiance))
    exposure = gains(radiance, sensors)[:, :, None, None, None] * column(lambda one: one.clipping)
    light = radiance * exposure * window
    sigmas = [one.blur_px if one.blur_px > 0.1 else 0.0 for one in sensors]
    blurred = blur(light.clamp_max(4), sigmas)
    light = torch.where(column(lambda one: float(one.blur_px > 0.1)) > 0, blurred, light)
    light = torch.lerp(light.clamp_max(1), 1 - torch.exp(-1.35 * light), column(lambda one: one.shoulder))
    grain = torch.randn(light.shape, generator=generator, device=light.device, dtype=light.dtype)
    level = light.clamp_min(0) ** column(lambda one: 1 / one.gamma)
    strength = column(lambda one: one.noise) * (0.3 + 0.7 * (window > 0))
    level = level + strength * (0.6 + 0.8 * level.sqrt()) * grain
    frames = (level * 255 + 0.5).clamp(0, 255).floor()
    return _coded(frames, sensors).to(torch.uint8)


def _corner(like: Tensor) -> Float[Tensor, "h w"]:
    """Squared distance from the image's middle; 1 in the corners."""
    height, width = like.shape[-2:]
    v = (torch.arange(height, device=like.device, dtype=like.dtype) + 0.5 - height / 2)[:, None]
    u = torch.arange(width, device=like.device, dtype=like.dtype) + 0.5 - width / 2
    return (u * u + v * v) / (0.25 * (width**2 + height**2))


def _coded(frames: Clips, sensors: Sequence[Sensor]) -> Clips:
    """The clips whose sensor compresses them, through JPEG."""
    chosen = [index for index, sensor in enumerate(sensors) if sensor.quality is not None]
    if chosen:
        qualities = [quality for sensor in sensors if (quality := sensor.quality) is not None]
        frames[chosen] = compress(frames[chosen], qualities)
    return frames

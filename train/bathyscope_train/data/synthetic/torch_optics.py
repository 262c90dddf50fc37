"""From radiance to the eight bits of a video, in torch: what ``optics.develop`` does, for several clips at once."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from bathyscope_train.data.synthetic.optics import _BURNT as BURNT
from bathyscope_train.data.synthetic.optics import Sensor, balances
from bathyscope_train.data.synthetic.torch_filters import blur
from bathyscope_train.data.synthetic.torch_formation import on_some
from bathyscope_train.data.synthetic.torch_jpeg import compress
from bathyscope_train.data.synthetic.torch_metering import gains, per_clip, views
from bathyscope_train.data.synthetic.torch_processor import colour_noise, hold_blocks, part_colours, scatter, sharpen

Clips = Float[Tensor, "b t 3 h w"]


def develop(
    radiance: Clips, sensors: Sequence[Sensor], generator: torch.Generator | None = None
) -> UInt8[Tensor, "b t 3 h w"]:
    """Turn linear radiance into displayed frames.

    Args:
        radiance: What reaches the chip.
        sensors: One camera head a clip.
        generator: Source of the noise, on the radiance's device.
    """
    column = _columns(radiance, sensors)
    view = views(sensors, radiance)
    window = view * (1 - column(lambda one: one.vignette) * _corner(radiance))
    light = radiance * gains(radiance, sensors)[:, :, None, None, None] * column(lambda one: one.clipping) * window
    colours = torch.from_numpy(np.stack([balances(one, radiance.shape[1]) for one in sensors]))
    light = _lens(light * colours.to(light)[..., None, None], view, sensors)
    grain = torch.randn(light.shape, generator=generator, device=light.device, dtype=light.dtype)
    grain = colour_noise(grain, [one.grain_px for one in sensors], [one.chroma for one in sensors])
    frames = (_levels(light, grain, window, sensors) * 255 + 0.5).clamp(0, 255).floor()
    return _coded(frames, sensors).to(torch.uint8)


def _columns(like: Clips, sensors: Sequence[Sensor]) -> Callable[[Callable[[Sensor], float]], Tensor]:
    """Makes a number of each sensor meet its clip."""
    return lambda pick: per_clip([pick(one) for one in sensors], like)


def _corner(like: Tensor) -> Float[Tensor, "h w"]:
    """Squared distance from the image's middle; 1 in the corners."""
    height, width = like.shape[-2:]
    v = (torch.arange(height, device=like.device, dtype=like.dtype) + 0.5 - height / 2)[:, None]
    u = torch.arange(width, device=like.device, dtype=like.dtype) + 0.5 - width / 2
    return (u * u + v * v) / (0.25 * (width**2 + height**2))


def _lens(light: Clips, view: Float[Tensor, "b 1 1 h w"], sensors: Sequence[Sensor]) -> Clips:
    """Glare, coloured fringes and blur of the lens."""

    def glare(clips: Clips, chosen: list[int]) -> Clips:
        return scatter(clips.clamp_max(BURNT), [sensors[n].glare for n in chosen]) * (view[chosen] > 0)

    light = on_some(light, [one.glare > 0 for one in sensors], glare)
    light = on_some(
        light,
        [one.fringe_px > 0.05 for one in sensors],
        lambda clips, chosen: part_colours(clips, [sensors[n].fringe_px for n in chosen]),
    )
    return on_some(
        light,
        [one.blur_px > 0.1 for one in sensors],
        lambda clips, chosen: blur(clips.clamp_max(BURNT), [sensors[n].blur_px for n in chosen]),
    )


def _levels(light: Clips, grain: Clips, window: Float[Tensor, "b 1 1 h w"], sensors: Sequence[Sensor]) -> Clips:
    """Noise, roll-off of the highlights, gamma curve, sharpening and writing."""
    column = _columns(light, sensors)
    seen = window > 0
    photons = light.clamp_min(0) * column(lambda one: one.shot**2) + column(lambda one: one.read**2)
    light = light + photons.sqrt() * grain * seen
    light = torch.lerp(light.clamp_max(1), 1 - torch.exp(-1.35 * light), column(lambda one: one.shoulder))
    level = light.clamp_min(0) ** column(lambda one: 1 / one.gamma)
    level = level + column(lambda one: one.noise) * (0.6 + 0.8 * level.sqrt()) * grain * (0.3 + 0.7 * seen)

    def crisp(clips: Clips, chosen: list[int]) -> Clips:
        some = [sensors[n] for n in chosen]
        return sharpen(clips, [one.sharpen for one in some], [one.sharpen_px for one in some])

    def written(clips: Clips, chosen: list[int]) -> Clips:
        writing = np.stack([overlay for n in chosen if (overlay := sensors[n].overlay) is not None])
        return torch.where(seen[chosen], clips, clips.maximum(torch.from_numpy(writing).to(clips)[:, None, None]))

    level = on_some(level, [one.sharpen > 0 for one in sensors], crisp)
    return on_some(level, [one.overlay is not None for one in sensors], written)


def _coded(frames: Clips, sensors: Sequence[Sensor]) -> Clips:
    """The clips whose sensor compresses them, through JPEG; some hold their still blocks."""
    frames = on_some(
        frames,
        [one.quality is not None for one in sensors],
        lambda clips, chosen: compress(clips, [sensors[n].quality or 0 for n in chosen]),
    )
    return on_some(
        frames,
        [one.quality is not None and one.hold > 0 for one in sensors],
        lambda clips, chosen: hold_blocks(clips, [sensors[n].hold for n in chosen]),
    )

"""From radiance to the eight bits of a video: air, lens, shutter, exposure, curve, noise, compression."""

from dataclasses import dataclass
from typing import TypedDict

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import SensorRanges, draw
from bathyscope_train.data.synthetic.focus import blur_px, defocus
from bathyscope_train.data.synthetic.haze import CLEAR, Haze, add_haze
from bathyscope_train.data.synthetic.processor import (
    colour_noise,
    compress,
    hold_blocks,
    part_colours,
    scatter,
    sharpen,
    white_balance,
    writing,
)
from bathyscope_train.data.synthetic.shutter import interlace, smear
from bathyscope_train.data.synthetic.view import draw_view

Array = npt.NDArray[np.float32]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_BURNT = 4.0  # light beyond this many times white is cut before it is spread


@dataclass(frozen=True, slots=True)
class Sensor:
    """The camera head of one clip; see ``SensorRanges`` for the meaning of the numbers. The defaults are off."""

    gamma: float
    exposure: float
    metering: float
    lag: float
    vignette: float
    clipping: float
    shoulder: float
    noise: float
    blur_px: float
    quality: int | None
    view: Array
    """``(h, w)``: share of light that the field of view lets through; 1 inside, 0 outside."""
    haze: Haze = CLEAR
    aperture_mm: float = 0.0
    focus: float = 1.0
    shutter: float = 0.0
    interlaced: bool = False
    glare: float = 0.0
    fringe_px: float = 0.0
    balance: tuple[float, float] = (0.0, 0.0)
    """Warmth and tint."""
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Amplitude of warmth and of tint, and the phase of their wave, whose period is 40 frames."""
    shot: float = 0.0
    read: float = 0.0
    grain_px: float = 0.0
    chroma: float = 1.0
    sharpen: float = 0.0
    sharpen_px: float = 1.0
    hold: float = 0.0
    overlay: Array | None = None
    """``(h, w)``: brightness of the writing outside the view."""

    @property
    def timed(self) -> bool:
        """Whether a frame is more than one instant."""
        return self.shutter > 0 or self.interlaced


def draw_sensor(random: np.random.Generator, ranges: SensorRanges, size: tuple[int, int], haze: Haze = CLEAR) -> Sensor:
    """Draw a camera head for images of ``size``."""
    blurred, compressed, masked = (random.uniform() for _ in range(3))
    more = random.spawn(1)[0]
    scale = size[1] / 140.0
    blur = draw(random, ranges.blur_px) * scale
    quality = round(draw(random, ranges.quality))
    view = draw_view(random, ranges, size)
    return Sensor(
        gamma=draw(random, ranges.gamma),
        exposure=draw(random, ranges.exposure),
        metering=draw(random, ranges.metering),
        lag=draw(random, ranges.lag),
        vignette=draw(random, ranges.vignette),
        clipping=draw(random, ranges.clipping),
        shoulder=draw(random, ranges.shoulder),
        noise=draw(random, ranges.noise),
        blur_px=blur if blurred < ranges.blurred else 0.0,
        quality=quality if compressed < ranges.compressed else None,
        view=view if masked < ranges.round_view else np.ones(size, np.float32),
        haze=haze,
        **_electronics(more, ranges, scale),
        aperture_mm=_sometimes(more, ranges.unfocused, ranges.aperture_mm),
        focus=draw(more, ranges.focus),
        shutter=_sometimes(more, ranges.smeared, ranges.shutter),
        interlaced=more.uniform() < ranges.interlaced,
        glare=_sometimes(more, ranges.glaring, ranges.glare),
        fringe_px=_sometimes(more, ranges.fringed, ranges.fringe_px) * scale,
        hold=_sometimes(more, ranges.held, ranges.hold),
        overlay=writing(more, size) if more.uniform() < ranges.overlay else None,
    )


class _Electronics(TypedDict):
    balance: tuple[float, float]
    drift: tuple[float, float, float]
    shot: float
    read: float
    grain_px: float
    chroma: float
    sharpen: float
    sharpen_px: float


def _electronics(random: np.random.Generator, ranges: SensorRanges, scale: float) -> _Electronics:
    """White balance, noise and sharpening; ``scale`` turns pixels of a usual image into those of this one."""
    tinted, grainy = random.uniform() < ranges.tinted, random.uniform() < ranges.grainy
    warmth, tint, drift = (draw(random, bounds) for bounds in (ranges.warmth, ranges.tint, ranges.drift))
    shot, read, grain_px, chroma = (
        draw(random, bounds) for bounds in (ranges.shot, ranges.read, ranges.grain_px, ranges.chroma)
    )
    side, phase = random.uniform(-0.5, 0.5), random.uniform(0.0, 2 * np.pi)
    return {
        "balance": (warmth, tint) if tinted else (0.0, 0.0),
        "drift": (drift, side * drift, phase) if tinted else (0.0, 0.0, 0.0),
        "shot": shot if grainy else 0.0,
        "read": read if grainy else 0.0,
        "grain_px": grain_px * scale if grainy else 0.0,
        "chroma": chroma if grainy else 1.0,
        "sharpen": _sometimes(random, ranges.sharpened, ranges.sharpen),
        "sharpen_px": draw(random, ranges.sharpen_px) * scale,
    }


def _sometimes(random: np.random.Generator, share: float, bounds: tuple[float, float]) -> float:
    """A number of the range in ``share`` of the draws, else 0."""
    happens, value = random.uniform() < share, draw(random, bounds)
    return value if happens else 0.0


def form_image(radiance: Array, depth: Array, motion: Array | None, focal_px: float, sensor: Sensor) -> Array:
    """What reaches the chip: the scene through smoke, out of focus, moving while the shutter is open.

    Args:
        radiance: ``(t, h, w, 3)``, left as it is.
        depth: ``(t, h, w)`` in millimetres.
        motion: ``(t, h, w, 2)``: pixels that the content moves until the next frame; ``None`` is stillness.
        focal_px: Focal length.
        sensor: Camera head; with everything off the radiance itself is returned.
    """
    smoky, deep = sensor.haze.opacity > 0, sensor.aperture_mm > 0
    if not (smoky or deep or (sensor.timed and motion is not None)):
        return radiance
    first = depth[0][(sensor.view > 0.5) & (depth[0] > 0)]
    median_mm = float(np.median(first)) if first.size else 1.0
    metered = _metered(radiance[0], sensor)
    formed = np.empty_like(radiance)
    for index, frame in enumerate(radiance):
        light = frame
        if smoky:
            light = add_haze(light, depth[index], sensor.haze, index, depth_mm=median_mm, metered=metered)
        if deep:
            light = defocus(light, blur_px(depth[index], focal_px, sensor.aperture_mm, sensor.focus * median_mm))
        if motion is not None and sensor.shutter > 0:
            light = smear(light, motion[index], sensor.shutter)
        if motion is not None and sensor.interlaced:
            light = interlace(light, motion[index])
        formed[index] = light
    return formed


def _metered(frame: Array, sensor: Sensor) -> float:
    """Luminance of the metered percentile inside the view."""
    return float(np.percentile(frame[sensor.view > 0.5] @ _LUMINANCE, sensor.metering))


def gains(radiance: Array, sensor: Sensor) -> npt.NDArray[np.float64]:
    """Exposure of every frame, ``(t,)``: steered by the brightness inside the view, with lag."""
    target = sensor.exposure**sensor.gamma
    result = np.empty(len(radiance))
    for index, frame in enumerate(radiance):
        wanted = target / max(_metered(frame, sensor), 1e-6)
        result[index] = wanted if index == 0 else result[index - 1] ** sensor.lag * wanted ** (1 - sensor.lag)
    return result


def balances(sensor: Sensor, frames: int) -> Array:
    """White balance of every frame, ``(t, 3)``."""
    wave = np.sin(2 * np.pi * np.arange(frames) / 40.0 + sensor.drift[2])
    return np.stack([white_balance(*(sensor.balance[k] + sensor.drift[k] * value for k in range(2))) for value in wave])


def develop(random: np.random.Generator, radiance: Array, sensor: Sensor) -> npt.NDArray[np.uint8]:
    """Turn linear radiance ``(t, h, w, 3)`` into displayed frames of the same shape.

    Args:
        random: Source of the noise.
        radiance: What reaches the chip.
        sensor: Camera head.
    """
    height, width = radiance.shape[1:3]
    v, u = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    corner = ((u / width - 0.5) ** 2 * width**2 + (v / height - 0.5) ** 2 * height**2) / (0.25 * (width**2 + height**2))
    window = (sensor.view * (1.0 - sensor.vignette * corner))[..., None]
    frames = np.empty(radiance.shape, np.uint8)
    tinted = any(sensor.balance) or any(sensor.drift[:2])
    colours = balances(sensor, len(radiance))
    for index, (frame, gain) in enumerate(zip(radiance, gains(radiance, sensor), strict=True)):
        light = frame * np.float32(gain * sensor.clipping) * window
        if tinted:
            light *= colours[index]
        light = _lens(light, sensor)
        grain = colour_noise(random.standard_normal(light.shape, dtype=np.float32), sensor.grain_px, sensor.chroma)
        frames[index] = _levels(light, grain, window, sensor)
        if sensor.quality is not None:
            frames[index] = compress(frames[index], sensor.quality)
            if sensor.hold > 0 and index > 0:
                frames[index] = hold_blocks(frames[index], frames[index - 1], sensor.hold)
    return frames


def _lens(light: Array, sensor: Sensor) -> Array:
    """Glare, coloured fringes and blur of the lens."""
    if sensor.glare > 0:
        light = scatter(np.minimum(light, _BURNT), sensor.glare) * (sensor.view[..., None] > 0)
    if sensor.fringe_px > 0.05:
        light = part_colours(light, sensor.fringe_px)
    if sensor.blur_px > 0.1:
        light = np.asarray(cv2.GaussianBlur(np.minimum(light, _BURNT), (0, 0), sensor.blur_px), np.float32)
    return light


def _levels(light: Array, grain: Array, window: Array, sensor: Sensor) -> npt.NDArray[np.uint8]:
    """Noise, roll-off of the highlights, gamma curve and sharpening."""
    if sensor.shot > 0 or sensor.read > 0:
        spread = np.sqrt(np.maximum(light, 0.0) * np.float32(sensor.shot**2) + np.float32(sensor.read**2))
        light = np.asarray(light + spread * grain * (window > 0), np.float32)
    bent = np.float32(1.0 - np.exp(-1.35 * light))
    rolled = (1 - sensor.shoulder) * np.minimum(light, 1.0) + sensor.shoulder * bent
    level = np.asarray(np.maximum(rolled, 0.0) ** np.float32(1.0 / sensor.gamma), np.float32)
    level += np.float32(sensor.noise) * (0.6 + 0.8 * np.sqrt(level)) * grain * (0.3 + 0.7 * (window > 0))
    if sensor.sharpen > 0:
        level = sharpen(level, sensor.sharpen, sensor.sharpen_px)
    if sensor.overlay is not None:
        level = np.asarray(np.where(window > 0, level, np.maximum(level, sensor.overlay[..., None])), np.float32)
    return np.asarray(np.clip(level * 255.0 + 0.5, 0, 255), np.uint8)

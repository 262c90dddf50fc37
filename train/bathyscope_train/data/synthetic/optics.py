"""From radiance to the eight bits of a video: exposure, curve, lens, field of view, noise, compression."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import SensorRanges, draw

Array = npt.NDArray[np.float32]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True, slots=True)
class Sensor:
    """The camera head of one clip; see ``SensorRanges`` for the meaning of the numbers."""

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
    view: npt.NDArray[np.float32]
    """``(h, w)``: share of light that the field of view lets through; 1 inside, 0 outside."""


def draw_sensor(random: np.random.Generator, ranges: SensorRanges, size: tuple[int, int]) -> Sensor:
    """Draw a camera head for images of ``size``."""
    blurred, compressed, masked = (random.uniform() for _ in range(3))
    blur = draw(random, ranges.blur_px) * size[1] / 140.0
    quality = round(draw(random, ranges.quality))
    view = _field_of_view(random, size)
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
    )


def _field_of_view(random: np.random.Generator, size: tuple[int, int]) -> Array:
    """A round view, often cut off by the frame above and below, or a frame with cut corners."""
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    x = (u - width / 2 - random.uniform(-0.03, 0.03) * width) / (width / 2)
    y = (v - height / 2 - random.uniform(-0.03, 0.03) * height) / (width / 2)
    edge = np.float32(random.uniform(0.005, 0.03))
    if random.uniform() < 0.7:
        outside = np.hypot(x, y) - random.uniform(0.72, 1.08)
    else:
        outside = np.abs(x) + np.abs(y) - random.uniform(1.35, 1.7)
    return np.asarray(np.clip(0.5 - outside / edge, 0.0, 1.0), np.float32)


def gains(radiance: Array, sensor: Sensor) -> npt.NDArray[np.float64]:
    """Exposure of every frame, ``(t,)``: steered by the brightness inside the view, with lag."""
    inside = sensor.view > 0.5
    target = sensor.exposure**sensor.gamma
    result = np.empty(len(radiance))
    for index, frame in enumerate(radiance):
        metered = float(np.percentile(frame[inside] @ _LUMINANCE, sensor.metering))
        wanted = target / max(metered, 1e-6)
        result[index] = wanted if index == 0 else result[index - 1] ** sensor.lag * wanted ** (1 - sensor.lag)
    return result


def develop(random: np.random.Generator, radiance: Array, sensor: Sensor) -> npt.NDArray[np.uint8]:
    """Turn linear radiance ``(t, h, w, 3)`` into displayed frames of the same shape.

    Args:
        random: Source of the noise.
        radiance: What reaches the lens.
        sensor: Camera head.
    """
    height, width = radiance.shape[1:3]
    v, u = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    corner = ((u / width - 0.5) ** 2 * width**2 + (v / height - 0.5) ** 2 * height**2) / (0.25 * (width**2 + height**2))
    window = (sensor.view * (1.0 - sensor.vignette * corner))[..., None]
    frames = np.empty(radiance.shape, np.uint8)
    for index, (frame, gain) in enumerate(zip(radiance, gains(radiance, sensor), strict=True)):
        light = frame * np.float32(gain * sensor.clipping) * window
        if sensor.blur_px > 0.1:
            light = cv2.GaussianBlur(np.minimum(light, 4.0), (0, 0), sensor.blur_px)
        bent = np.float32(1.0 - np.exp(-1.35 * light))
        light = (1 - sensor.shoulder) * np.minimum(light, 1.0) + sensor.shoulder * bent
        grain = random.standard_normal(light.shape, dtype=np.float32)
        level = np.maximum(light, 0.0) ** np.float32(1.0 / sensor.gamma)
        level += np.float32(sensor.noise) * (0.6 + 0.8 * np.sqrt(level)) * grain * (0.3 + 0.7 * (window > 0))
        frames[index] = np.clip(level * 255.0 + 0.5, 0, 255).astype(np.uint8)
        if sensor.quality is not None:
            frames[index] = _compress(frames[index], sensor.quality)
    return frames


def _compress(frame: npt.NDArray[np.uint8], quality: int) -> npt.NDArray[np.uint8]:
    coded = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded[..., ::-1], np.uint8)

"""Smooth periodic noise whose grain is given in millimetres."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


def _wavenumbers(shape: tuple[int, ...], step_mm: tuple[float, ...]) -> list[Array]:
    """Cycles per millimetre along every axis, shaped for broadcasting over a real transform."""
    last = len(shape) - 1
    axes = [
        (np.fft.rfftfreq if axis == last else np.fft.fftfreq)(n, step)
        for axis, (n, step) in enumerate(zip(shape, step_mm, strict=True))
    ]
    return [
        np.asarray(k, np.float32).reshape([-1 if i == axis else 1 for i in range(last + 1)])
        for axis, k in enumerate(axes)
    ]


def _band(wavenumbers: list[Array], grain_mm: float, slope: float) -> Array:
    """Amplitude over frequency: flat up to 1 / grain, then falling with ``slope``, no mean."""
    radius = np.sqrt(np.sum(np.stack(np.broadcast_arrays(*[k**2 for k in wavenumbers])), axis=0)) * grain_mm
    band = (1.0 + radius**2) ** (-slope / 2)
    band[(0,) * band.ndim] = 0.0
    return np.asarray(band, np.float32)


def periodic_noise(
    random: np.random.Generator, shape: tuple[int, ...], step_mm: tuple[float, ...], grain_mm: float, slope: float = 4.0
) -> Array:
    """Noise of mean 0 and standard deviation 1 that repeats at the borders.

    Args:
        random: Source of the white noise.
        shape: Samples along each axis.
        step_mm: Distance of two samples along each axis.
        grain_mm: Size below which the noise fades out.
        slope: How quickly it fades; 2 is rough, 6 nearly band-limited.
    """
    white = np.fft.rfftn(random.standard_normal(shape, dtype=np.float32))
    noise = np.fft.irfftn(white * _band(_wavenumbers(shape, step_mm), grain_mm, slope), s=shape, axes=range(len(shape)))
    return np.asarray(noise / (noise.std() + 1e-12), np.float32)


def gradient_noise(
    random: np.random.Generator, shape: tuple[int, ...], step_mm: tuple[float, ...], grain_mm: float
) -> Array:
    """Gradient of periodic noise, ``(*shape, dimensions)``, with a root mean square length of 1."""
    wavenumbers = _wavenumbers(shape, step_mm)
    white = np.fft.rfftn(random.standard_normal(shape, dtype=np.float32)) * _band(wavenumbers, grain_mm, 6.0)
    axes = range(len(shape))
    slopes = np.stack([np.fft.irfftn(2j * np.pi * k * white, s=shape, axes=axes) for k in wavenumbers], axis=-1)
    return np.asarray(slopes / (np.sqrt((slopes**2).sum(-1).mean()) + 1e-12), np.float32)

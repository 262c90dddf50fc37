r"""Depth of field: what is out of focus spreads over a disc whose size depends on its depth.

A thin lens of aperture :math:`A` and focal length :math:`f` (pixels), focused at :math:`z_f`, spreads a point at
depth :math:`z` over a disc of diameter :math:`A f |1/z - 1/z_f|` pixels. A Gaussian of a quarter of the diameter as
standard deviation has the disc's second moment. The image is mixed from four blurred copies.
"""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

_LARGEST_PX = 3.5  # standard deviation, for an image 140 pixels wide
_LEAST_PX = 0.15
_STEPS = (0.0, 0.2, 0.5, 1.0)


def blur_px(depth: Array, focal_px: float, aperture_mm: float, focus_mm: float) -> Array:
    """Standard deviation of the blur of every pixel, ``(h, w)``; 0 where depth is 0."""
    safe = np.where(depth > 0, depth, np.float32(focus_mm))
    return np.asarray(0.25 * aperture_mm * focal_px * np.abs(1.0 / safe - 1.0 / focus_mm), np.float32)


def defocus(radiance: Array, spread: Array) -> Array:
    """Blur an image ``(h, w, 3)`` by ``spread`` ``(h, w)`` pixels; its labels are left alone."""
    largest = _LARGEST_PX * radiance.shape[1] / 140.0
    if spread.max() < _LEAST_PX:
        return radiance
    smooth = cv2.GaussianBlur(spread, (0, 0), 1.0, borderType=cv2.BORDER_REFLECT)
    place = np.interp(smooth, [largest * step for step in _STEPS], range(len(_STEPS))).astype(np.float32)
    mixed = radiance * np.maximum(1.0 - place, 0.0)[..., None]
    for level, step in enumerate(_STEPS[1:], start=1):
        weight = np.maximum(1.0 - np.abs(place - level), 0.0)
        if weight.any():
            blurred = cv2.GaussianBlur(radiance, (0, 0), step * largest, borderType=cv2.BORDER_REFLECT)
            mixed += blurred * weight[..., None]
    return np.asarray(mixed, np.float32)

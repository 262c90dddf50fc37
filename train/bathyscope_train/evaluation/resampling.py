"""Predicted maps at the size of the truth, in the order in which a protocol resizes and inverts."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size
from bathyscope.errors import GeometryError

F32 = NDArray[np.float32]
Resize = Literal["as_given", "disparity", "depth"]
"""What is interpolated: the quantity that the system gives, disparity, or depth."""
RESIZE_WORDS: dict[Resize, str] = {
    "as_given": "depth or disparity, whichever the system gives, is resized to the truth, bilinear",
    "disparity": "disparity is resized to the truth, bilinear, and inverted afterwards",
    "depth": "depth is resized to the truth, bilinear",
}


def inverted(values: NDArray[np.floating]) -> F32:
    """Depth of disparity and the other way round; 0 becomes infinite and the other way round.

    Raises:
        GeometryError: If a value is negative or NaN.
    """
    if not (np.asarray(values) >= 0).all():
        raise GeometryError("depth and disparity cannot be negative or NaN; mark such pixels as not valid instead")
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.asarray(values, np.float32), np.float32)


def resized(values: F32, size: Size) -> F32:
    """Bilinear with half-pixel centres, as OpenCV does it."""
    import cv2

    if values.shape == size:
        return values
    return np.asarray(cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR), np.float32)


def depth_at(
    values: F32, valid: NDArray[np.bool_], quantity: Literal["depth", "disparity"], size: Size, order: Resize
) -> tuple[F32, NDArray[np.bool_]]:
    """Predicted depth at the size of the truth.

    A pixel that is not valid never leaks into its neighbours: interpolation weighs valid pixels only, and the result
    is valid where they make up at least half of the weight.

    Args:
        values: Depth or disparity (h, w).
        valid: (h, w) where the values mean something.
        quantity: What they are.
        size: (H, W) of the truth.
        order: What is interpolated.

    Returns:
        Depth (H, W), infinite where disparity is 0, and 0 where not valid; and (H, W) where it is valid.

    Raises:
        GeometryError: If ``valid`` has another shape, or a valid value is negative or NaN.
    """
    if valid.shape != values.shape:
        raise GeometryError(f"values of shape {values.shape} have a mask of shape {valid.shape}")
    wanted = quantity if order == "as_given" else order
    given = np.where(valid, values, np.float32(0))
    if not (given >= 0).all():
        raise GeometryError("a predicted value is negative or NaN and not marked as not valid")
    if values.shape == size:
        depth = given if quantity == "depth" else inverted(given)
        keep = valid & (depth > 0)
        return np.where(keep, depth, np.float32(0)), keep
    source = given if wanted == quantity else np.where(valid & (given > 0), inverted(given), np.float32(0))
    usable = valid & np.isfinite(source) & ((source > 0) | (wanted == "disparity"))
    weight = np.ones(size, np.float32) if usable.all() else resized(usable.astype(np.float32), size)
    keep = weight >= 0.5
    mean = resized(np.where(usable, source, np.float32(0)), size) / np.where(keep, weight, np.float32(1))
    depth = mean if wanted == "depth" else inverted(mean)
    keep &= depth > 0
    return np.where(keep, depth, np.float32(0)), keep

"""Picture grids of a clip: input, rendered image, depth, opacity and error, a row for each frame."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from bathyscope_train.consistency.rendering import ClipRendering

_FRAMES = 4
_GAP = 2
_LARGEST_ERROR = 0.25
"""Mean difference of colours that is white in the last column."""


def picture_grid(
    images: Float[Tensor, "t 3 h w"], rendered: ClipRendering, *, clip: int = 0, frames: int = _FRAMES
) -> NDArray[np.uint8]:
    """RGB grid (H, W, 3) of a few frames spread over one clip.

    Columns: input, rendered image, depth (near is bright; one range for the clip), opacity (white is opaque), and
    error (mean difference of colours). A network without Gaussians has no rendered image and no error.

    Args:
        images: The frames of the clip.
        rendered: Of the batch that it belongs to.
        clip: Its place there.
        frames: Rows at most.
    """
    chosen = np.unique(np.linspace(0, len(images) - 1, frames).round().astype(int))
    depth = _array(rendered.depth[clip])
    bounds = _bounds(depth)
    return np.concatenate(
        [_row(_array(images[frame]), _frame(rendered, clip, int(frame)), bounds) for frame in chosen], axis=0
    )


def _frame(rendered: ClipRendering, clip: int, frame: int) -> tuple[NDArray[np.float32], ...]:
    """Depth, opacity and, where there is one, image of a frame."""
    maps = [rendered.depth, rendered.opacity, *([] if rendered.image is None else [rendered.image])]
    return tuple(_array(each[clip, frame]) for each in maps)


def _row(
    frame: NDArray[np.float32], maps: tuple[NDArray[np.float32], ...], bounds: tuple[float, float]
) -> NDArray[np.uint8]:
    image = frame.transpose(1, 2, 0)
    depth, opacity, *rendered = maps
    shown, error = np.zeros_like(image), np.zeros_like(depth)
    if rendered:
        shown = np.clip(rendered[0].transpose(1, 2, 0), 0, 1)
        error = np.abs(shown - image).mean(-1) / _LARGEST_ERROR
    grey = [_bytes(np.repeat(each[..., None], 3, -1)) for each in (opacity, error)]
    parts = [_bytes(image), _bytes(shown), _coloured(depth, bounds), *grey]
    return np.concatenate([np.pad(part, ((0, _GAP), (0, _GAP), (0, 0))) for part in parts], axis=1)


def _bounds(depth: NDArray[np.float32]) -> tuple[float, float]:
    known = depth[depth > 0]
    low, high = np.percentile(known, (2, 98)) if known.size else (1.0, 2.0)
    return float(low), float(max(high, low * 1.01))


def _coloured(depth: NDArray[np.float32], bounds: tuple[float, float]) -> NDArray[np.uint8]:
    """Even steps of inverse depth in colours; black where nothing was rendered."""
    low, high = bounds
    share = (1 / np.clip(depth, low, high) - 1 / high) / (1 / low - 1 / high)
    coloured = cv2.applyColorMap(_bytes(share), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where((depth > 0)[..., None], coloured, 0).astype(np.uint8)


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray((np.clip(values, 0, 1) * 255).round(), np.uint8)


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.asarray(values.detach().float().cpu().numpy(), np.float32)

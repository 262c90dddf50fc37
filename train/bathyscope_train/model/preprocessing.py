"""Images of any size to the sizes the published networks were run at; for checking them, not for serving.

Every function takes one RGB image (h, w, 3), uint8, and gives uint8 back; divide by 255 for the network.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Pixels = NDArray[np.uint8]

_WHITE = 255


def square_crop(image: Pixels, side: int = 448) -> Pixels:
    """AnySplat's inference input: the shorter side becomes ``side``, the longer one is cropped about its middle."""
    height, width = image.shape[:2]
    new_width, new_height = (
        (int(width * (side / height)), side) if width > height else (side, int(height * (side / width)))
    )
    resized = _resize(image, new_width, new_height)
    top, left = (new_height - side) // 2, (new_width - side) // 2
    return resized[top : top + side, left : left + side]


def fit(image: Pixels, target: int = 518, *, mode: Literal["crop", "pad"], patch: int = 14) -> Pixels:
    """VGGT's loader: sides become multiples of ``patch``.

    ``crop`` makes the width ``target`` and crops rows beyond ``target`` about the middle; ``pad`` makes the longer
    side ``target`` and fills up to a square with white, the smaller half first.
    """
    height, width = image.shape[:2]
    if mode == "crop":
        new_height = _to_multiple(height * (target / width), patch)
        resized = _resize(image, target, new_height)
        top = max(new_height - target, 0) // 2
        return resized[top : top + target]
    if width >= height:
        resized = _resize(image, target, _to_multiple(height * (target / width), patch))
    else:
        resized = _resize(image, _to_multiple(width * (target / height), patch), target)
    return pad_white(resized, (target, target))


def pad_white(image: Pixels, size: tuple[int, int]) -> Pixels:
    """``image`` in the middle of a white one of ``size``; of an odd border the smaller half comes first."""
    down, across = size[0] - image.shape[0], size[1] - image.shape[1]
    borders = ((down // 2, down - down // 2), (across // 2, across - across // 2), (0, 0))
    return np.pad(image, borders, constant_values=_WHITE)


def flatten_alpha(image: Pixels, *, onto_white: bool) -> Pixels:
    """RGB of an RGBA image (h, w, 4): composited on white (VGGT's loader) or with alpha dropped (AnySplat's)."""
    if not onto_white:
        return image[..., :3]
    picture = Image.fromarray(image, "RGBA")
    canvas = Image.new("RGBA", picture.size, (_WHITE,) * 4)
    return np.asarray(Image.alpha_composite(canvas, picture).convert("RGB"))


def _to_multiple(length: float, patch: int) -> int:
    return round(length / patch) * patch


def _resize(image: Pixels, width: int, height: int) -> Pixels:
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC))

"""The part of the image that an endoscope fills: a disc, often cut off, a frame with cut corners, a rectangle."""

import numpy as np
import numpy.typing as npt

from bathyscope_train.data.synthetic.domain import SensorRanges, choose, draw

Array = npt.NDArray[np.float32]


def draw_view(random: np.random.Generator, ranges: SensorRanges, size: tuple[int, int]) -> Array:
    """Share of light that reaches each pixel, ``(h, w)``: 1 inside, 0 outside, a soft edge between.

    With (x, y) the distance from the view's middle in half image widths, inside is

    * a disc: ``hypot(x, y) < radius``; above 0.8 the frame of a 5:4 image cuts it off above and below;
    * cut corners: ``|x| + |y| < reach``;
    * a rectangle with rounded corners: ``hypot(max(|x| - a, 0), max(|y| - b, 0)) < corner``.
    """
    height, width = size
    shape = choose(random, ranges.views)
    v, u = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    x = np.abs(u - width / 2 - draw(random, ranges.view_offset) * width) / (width / 2)
    y = np.abs(v - height / 2 - draw(random, ranges.view_offset) * width) / (width / 2)
    edge = np.float32(random.uniform(0.005, 0.03))
    share = random.uniform()
    if shape == "round":
        outside = np.hypot(x, y) - (0.72 + 0.36 * share)
    elif shape == "corners":
        outside = x + y - (1.35 + 0.35 * share)
    else:
        more = random.spawn(1)[0]
        corner, tall = more.uniform(0.0, 0.25), more.uniform(0.8, 1.0)
        half = np.array([0.65 + 0.33 * share, tall * height / width])
        beyond = np.maximum(np.stack([x, y], axis=-1) - (half - corner), 0.0)
        outside = np.hypot(beyond[..., 0], beyond[..., 1]) - corner
    return np.asarray(np.clip(0.5 - outside / edge, 0.0, 1.0), np.float32)

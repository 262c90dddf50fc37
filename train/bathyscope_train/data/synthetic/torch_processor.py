"""What lens and electronics do to pictures, in torch; see ``processor`` for the equations."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.data.synthetic.processor import _BLOCK as BLOCK
from bathyscope_train.data.synthetic.torch_filters import (
    blur,
    blur_matrix,
    filter_images,
    mean_matrix,
    sampling_matrix,
    stacked,
)
from bathyscope_train.data.synthetic.torch_metering import per_clip

Array = npt.NDArray[np.float64]
Clips = Float[Tensor, "b t 3 h w"]

_LEAST_GRAIN_PX = 0.2


def colour_noise(grain: Clips, sigmas: Sequence[float], chroma: Sequence[float]) -> Clips:
    """Give white noise the look of demosaicing, at the same standard deviation of its brightness."""
    if max(sigmas) == 0 and all(one == 1 for one in chroma):
        return grain
    grey = grain.mean(2, keepdim=True)
    colour = _even_blur(grain - grey, [2 * sigma for sigma in sigmas])
    return _even_blur(grey, sigmas) + per_clip(chroma, grain) * colour


def _even_blur(noise: Float[Tensor, "b t c h w"], sigmas: Sequence[float]) -> Tensor:
    """Blur white noise and make up for the contrast lost."""

    def matrix(size: int, sigma: float) -> Array:
        if sigma < _LEAST_GRAIN_PX:
            return np.eye(size)
        radius = int(np.ceil(3 * sigma))
        taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
        left = float(((taps / taps.sum()) ** 2).sum())
        return np.asarray(blur_matrix(size, sigma, radius=radius) / np.sqrt(left))

    rows, columns = (stacked([matrix(size, sigma) for sigma in sigmas], noise) for size in noise.shape[-2:])
    return filter_images(noise, rows, columns)


def sharpen(level: Clips, strengths: Sequence[float], sigmas: Sequence[float]) -> Clips:
    """Unsharp masking; edges get halos."""
    return level + per_clip(strengths, level) * (level - blur(level, sigmas))


def part_colours(light: Clips, fringes: Sequence[float]) -> Clips:
    """Lateral colour of lenses: red grows and blue shrinks by the fringe at the left and right border."""
    width = light.shape[-1]
    planes = list(light.unbind(2))
    for channel, sign in ((0, 1.0), (2, -1.0)):
        scales = [1 - sign * fringe / (width / 2) for fringe in fringes]
        rows, columns = (
            stacked(
                [sampling_matrix(s * np.arange(n) + (1 - s) * (n - 1) / 2, n) for s in scales],
                light,
            )
            for n in light.shape[-2:]
        )
        planes[channel] = filter_images(planes[channel], rows, columns)
    return torch.stack(planes, 2)


def scatter(light: Clips, shares: Sequence[float]) -> Clips:
    """Glare: some of the light is spread over a tenth of the image's width; the sum stays."""
    height, width = light.shape[-2:]

    def spread(size: int) -> Tensor:
        small = max(size // 4, 1)
        wide = blur_matrix(small, max(width / 40, 0.5), "reflect") @ mean_matrix(size, small)
        return stacked([sampling_matrix((np.arange(size) + 0.5) * small / size - 0.5, small) @ wide], light)

    share = per_clip(shares, light)
    return (1 - share) * light + share * filter_images(light, spread(height), spread(width))


def hold_blocks(frames: Clips, thresholds: Sequence[float]) -> Clips:
    """Keep the blocks that changed little since the frame before, as video coders do; levels 0 to 255."""
    height, width = frames.shape[-2:]
    threshold = per_clip(thresholds, frames[:, 0, :1])
    held = [frames[:, 0]]
    for frame in frames.unbind(1)[1:]:
        change = (frame - held[-1]).abs().mean(1, keepdim=True)
        change = F.pad(change, (0, -width % BLOCK, 0, -height % BLOCK), mode="replicate")
        still = (F.avg_pool2d(change, BLOCK) < threshold).repeat_interleave(BLOCK, -1).repeat_interleave(BLOCK, -2)
        held.append(torch.where(still[..., :height, :width], held[-1], frame))
    return torch.stack(held, 1)

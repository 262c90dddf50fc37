"""How different two pictures look: structure and colour, and the warps that make them comparable.

The conventions are those of the self-supervised line of EndoDAC and EndoDAV: images in [0, 1], the centre of the first
pixel is (0, 0), and the centres of the outermost pixels are the corners of the sampling grid.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.unprojection import unproject

_LUMINANCE, _CONTRAST = 0.01**2, 0.03**2
_SAFE_DEPTH = 1e-7


def structural_dissimilarity(
    first: Float[Tensor, "n c h w"], second: Float[Tensor, "n c h w"]
) -> Float[Tensor, "n c h w"]:
    r"""``clamp((1 - SSIM) / 2, 0, 1)`` of every pixel and channel, with means over 3x3 windows (borders reflected).

    .. math:: SSIM = \frac{(2 \mu_a \mu_b + C_1)(2 \sigma_{ab} + C_2)}
              {(\mu_a^2 + \mu_b^2 + C_1)(\sigma_a^2 + \sigma_b^2 + C_2)}, \quad C_1 = 0.01^2, C_2 = 0.03^2
    """
    a, b = (F.pad(image, (1, 1, 1, 1), mode="reflect") for image in (first, second))
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a.square()) - mean_a.square()
    variance_b = _window_mean(b.square()) - mean_b.square()
    covariance = _window_mean(a * b) - mean_a * mean_b
    above = (2 * mean_a * mean_b + _LUMINANCE) * (2 * covariance + _CONTRAST)
    below = (mean_a.square() + mean_b.square() + _LUMINANCE) * (variance_a + variance_b + _CONTRAST)
    return ((1 - above / below) / 2).clamp(0, 1)


def photometric_error(
    first: Float[Tensor, "n c h w"], second: Float[Tensor, "n c h w"], *, structure: float = 0.85
) -> Float[Tensor, "n 1 h w"]:
    r"""``a mean_c clamp((1 - SSIM)/2, 0, 1) + (1 - a) mean_c |first - second|`` with a = ``structure``."""
    colour = (first - second).abs().mean(1, keepdim=True)
    shape = structural_dissimilarity(first, second).mean(1, keepdim=True)
    return structure * shape + (1 - structure) * colour


def masked_average(values: Float[Tensor, "n k h w"], mask: Float[Tensor, "n 1 h w"]) -> Float[Tensor, ""]:
    """``sum(mask * values) / sum(mask)`` over one or several channels; 0 where the mask is empty."""
    weight = mask.expand_as(values)
    total = weight.sum()
    return (values * weight).sum() / torch.where(total > 0, total, torch.ones_like(total))


def warp_by_flow(source: Float[Tensor, "n c h w"], flow: Float[Tensor, "n 2 h w"]) -> Float[Tensor, "n c h w"]:
    """``source`` sampled at every pixel plus its flow; outside, the border is repeated.

    Args:
        source: Maps to sample.
        flow: Where to, in pixels; channels in the order (y, x).
    """
    height, width = flow.shape[-2:]
    rows = torch.arange(height, device=flow.device, dtype=flow.dtype)[:, None] + flow[:, 0]
    columns = torch.arange(width, device=flow.device, dtype=flow.dtype) + flow[:, 1]
    return sample(source, torch.stack((columns, rows), dim=-1))


def warp_by_depth(
    source: Float[Tensor, "n c h w"],
    depth: Float[Tensor, "n h w"],
    source_from_target: Float[Tensor, "n 4 4"],
    intrinsics: Float[Tensor, "n 3 3"],
) -> Float[Tensor, "n c h w"]:
    """``source`` as the target's camera sees it: sampled where the target's pixels, lifted by ``depth``, project to."""
    pixels, _ = reproject(depth, source_from_target, intrinsics)
    return sample(source, pixels)


def reproject(
    depth: Float[Tensor, "n h w"],
    source_from_target: Float[Tensor, "n 4 4"],
    intrinsics: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n h w 2"], Float[Tensor, "n h w"]]:
    """Where every pixel of the target lies in the source, ``(u, v)`` in pixels, and its depth there.

    Args:
        depth: Z-depth of the target.
        source_from_target: Maps points of the target's camera to the source's.
        intrinsics: Of both, in pixels; the centre of the first pixel is (0, 0).
    """
    points = unproject(depth, intrinsics, source_from_target, pixel_center=0.0)
    projected = points @ intrinsics[:, None].transpose(-1, -2)
    return projected[..., :2] / (projected[..., 2:] + _SAFE_DEPTH), points[..., 2]


def grid_coordinates(pixels: Float[Tensor, "n h w 2"], size: tuple[int, int]) -> Float[Tensor, "n h w 2"]:
    """Pixels ``(u, v)`` of an image of ``size`` (height, width) as -1 to 1 from the first pixel to the last."""
    last = pixels.new_tensor((size[1] - 1, size[0] - 1))
    return 2 * pixels / last - 1


def sample(
    maps: Float[Tensor, "n c h w"], pixels: Float[Tensor, "n h2 w2 2"], *, padding: str = "border"
) -> Float[Tensor, "n c h2 w2"]:
    """Bilinear samples at ``pixels`` (u, v), whole numbers being pixel centres."""
    grid = grid_coordinates(pixels, (maps.shape[-2], maps.shape[-1]))
    return F.grid_sample(maps, grid, mode="bilinear", padding_mode=padding, align_corners=True)


def _window_mean(maps: Tensor) -> Tensor:
    return F.avg_pool2d(maps, 3, stride=1)

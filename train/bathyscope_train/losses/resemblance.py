"""How different two pictures look, in structure and in colour: the comparison of EndoDAC and EndoDAV."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_LUMINANCE, _CONTRAST = 0.01**2, 0.03**2


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


def _window_mean(maps: Tensor) -> Tensor:
    return F.avg_pool2d(maps, 3, stride=1)

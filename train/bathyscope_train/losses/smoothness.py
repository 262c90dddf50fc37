"""Smoothness that gives way where a guiding picture has edges: of disparities, flows and changes of colour."""

from jaxtyping import Float
from torch import Tensor

from bathyscope_train.losses.resemblance import masked_average

_SAFE_MEAN = 1e-7


def edge_aware_smoothness(values: Float[Tensor, "n k h w"], image: Float[Tensor, "n c h w"]) -> Float[Tensor, ""]:
    r"""Mean of ``|d values| exp(-mean_c |d image|)`` over neighbours across, plus the same over neighbours down.

    .. math:: \overline{|\partial_x v|\, e^{-|\partial_x I|}} + \overline{|\partial_y v|\, e^{-|\partial_y I|}}
    """
    return _both_directions(values, image, None)


def disparity_smoothness(disparity: Float[Tensor, "n 1 h w"], image: Float[Tensor, "n c h w"]) -> Float[Tensor, ""]:
    """:func:`edge_aware_smoothness` of the disparity over its mean in each image: shrinking it gains nothing."""
    return edge_aware_smoothness(disparity / (disparity.mean((2, 3), keepdim=True) + _SAFE_MEAN), image)


def appearance_smoothness(
    change: Float[Tensor, "n c h w"], difference: Float[Tensor, "n c h w"], mask: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, ""]:
    """Smoothness of a change of colour, inside ``mask``, that gives way where the difference it explains has edges.

    Args:
        change: The predicted change of colour.
        difference: Target less what was warped onto it; its edges are the ones that count.
        mask: 1 where a pixel is seen in both images. A pair of neighbours counts as its first pixel (left, upper) does.
    """
    return _both_directions(change, difference, mask)


def _both_directions(values: Tensor, guide: Tensor, mask: Tensor | None) -> Float[Tensor, ""]:
    """Weighted differences of ``values`` averaged over neighbours across, and down, added."""
    total = values.new_zeros(())
    for axis in (2, 3):
        length = values.shape[axis] - 1
        steps = values.diff(dim=axis).abs().mean(1, keepdim=True)
        weights = (-guide.diff(dim=axis).abs().mean(1, keepdim=True)).exp()
        weighted = steps * weights
        inside = None if mask is None else mask.narrow(axis, 0, length)
        total = total + (weighted.mean() if inside is None else masked_average(weighted, inside))
    return total

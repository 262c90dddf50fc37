"""Image-level consistency: the rendered image is the frame (Eq. 2)."""

from __future__ import annotations

from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

Reduction = Literal["sum", "mean"]

LEAST_OPACITY = 0.05
"""Below this a colour divided by its opacity is noise: the pixel is charged for what was rendered, the hole."""


def photometric_loss(
    image: Float[Tensor, "b t 3 h w"],
    frames: Float[Tensor, "b t 3 h w"],
    valid: Bool[Tensor, "b t h w"],
    *,
    opacity: Float[Tensor, "b t h w"] | None = None,
    reduction: Reduction = "sum",
) -> Float[Tensor, ""]:
    r"""Absolute difference between what is rendered and what was filmed.

    .. math:: \mathcal{L}_{rgb} = \sum_t \frac{1}{3 |\Omega_t|} \sum_{u \in \Omega_t}
              \big\| I_t(u) - \hat I_t(u) \big\|_1

    Readings. The norm of an image is the *mean* over its valid pixels and colours: as a sum it would weigh 3 h w times
    as much as the other two terms, which are means over pixels, and depend on the resolution. Frames are *summed* as
    written (``mean`` divides by t). The paper names no pixels to leave out; :math:`\Omega_t` is meant for what no
    scene explains: outside the field of view, over-exposed, highlights. It must come from the frames, never from what
    is rendered, or it could be escaped. A frame without valid pixels adds zero.

    Which Gaussians are rendered is the caller's choice. With *all* of them each pixel is painted by its own Gaussian,
    and the loss hardly knows about depth; *leaving out* the frame's own
    (:func:`bathyscope_train.render.leave_one_out`) makes the other frames explain it. Then there are true holes, and
    edges of partial opacity, which are dark over a black background whatever the depth: with ``opacity`` the colour
    is divided by it first. A hole, where opacity is next to nothing, still costs its whole brightness: opening one
    never pays.

    The scale of the scene cancels: a scene shrunk together with its poses renders the same image.

    Args:
        image: Rendered RGB over black.
        frames: The input, RGB in [0, 1].
        valid: Pixels that count.
        opacity: Rendered opacity, to divide by where it is at least :data:`LEAST_OPACITY`.
        reduction: Over the frames of a clip; the mean is taken over clips.
    """
    shown = image
    if opacity is not None:
        covered = opacity.detach() >= LEAST_OPACITY
        shown = image / opacity.where(covered, opacity.new_ones(()))[:, :, None]
    difference = (shown - frames).abs().mean(2)
    return over_frames(mean_of_frames(difference, valid), reduction)


def mean_of_frames(values: Float[Tensor, "b n h w"], valid: Bool[Tensor, "b n h w"]) -> Float[Tensor, "b n"]:
    """Mean over the valid pixels of each map; 0 where there is none. What is not valid may be anything, also NaN."""
    kept = values.where(valid, values.new_zeros(()))
    return kept.sum((-2, -1)) / valid.sum((-2, -1)).clamp_min(1)


def over_frames(values: Float[Tensor, "b n"], reduction: Reduction) -> Float[Tensor, ""]:
    """Sum or mean over frames or pairs, then the mean over clips."""
    return (values.sum(1) if reduction == "sum" else values.mean(1)).mean()

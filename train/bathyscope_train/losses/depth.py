"""Supervised depth: logarithmic differences, their gradients at two distances, and an honest confidence."""

from jaxtyping import Bool, Float
from torch import Tensor

GRADIENT_GAPS = (1, 4)
"""Pixels between the two ends of a finite difference."""

CONFIDENCE_PRIOR = 0.1
"""The error at which the best confidence is 1; ten times smaller errors deserve a ten times larger one."""


def log_depth_loss(
    depth: Float[Tensor, "b t h w"], true: Float[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of the logarithms over valid pixels; both depths in one unit."""
    return masked_mean((depth.log() - safe_log(true)).abs(), valid)


def gradient_loss(
    depth: Float[Tensor, "b t h w"], true: Float[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of the finite differences of the logarithms, summed over :data:`GRADIENT_GAPS`."""
    error = depth.log() - safe_log(true)
    total = error.new_zeros(())
    for gap in GRADIENT_GAPS:
        down = masked_mean(
            (error[..., gap:, :] - error[..., :-gap, :]).abs(), valid[..., gap:, :] & valid[..., :-gap, :]
        )
        across = masked_mean((error[..., gap:] - error[..., :-gap]).abs(), valid[..., gap:] & valid[..., :-gap])
        total = total + (down + across) / 2
    return total


def confidence_loss(
    confidence: Float[Tensor, "b t h w"], error: Float[Tensor, "b t h w"], valid: Bool[Tensor, "b t h w"]
) -> Float[Tensor, ""]:
    """Mean of ``c e - prior log c``: least where the confidence c is the prior over the error e.

    The error is the absolute difference of the logarithms, without a gradient: confidence never trades depth away.
    """
    return masked_mean(confidence * error.detach() - CONFIDENCE_PRIOR * confidence.log(), valid)


def masked_mean(values: Float[Tensor, "*n"], valid: Bool[Tensor, "*n"]) -> Float[Tensor, ""]:
    """Mean over what is valid; 0 where nothing is."""
    weight = valid.to(values.dtype)
    return (values * weight).sum() / weight.sum().clamp_min(1)


def safe_log(depth: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Logarithm that stays finite where there is no depth."""
    return depth.clamp_min(1e-6).log()

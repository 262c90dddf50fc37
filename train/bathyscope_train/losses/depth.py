"""Supervised depth: logarithmic differences, their gradients at two distances, and an honest confidence."""

import torch
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


def normal_loss(
    depth: Float[Tensor, "b t h w"],
    true: Float[Tensor, "b t h w"],
    valid: Bool[Tensor, "b t h w"],
    focal: Float[Tensor, "b"],
) -> Float[Tensor, ""]:
    """Mean of 1 - cosine between the normals of the two surfaces, over pixels whose neighbours are valid."""
    cosine = (surface_normals(depth, focal) * surface_normals(true.clamp_min(1e-6), focal)).sum(-1)
    whole = valid[..., 1:-1, 1:-1] & valid[..., 2:, 1:-1] & valid[..., :-2, 1:-1]
    whole = whole & valid[..., 1:-1, 2:] & valid[..., 1:-1, :-2]
    return masked_mean(1 - cosine, whole)


def surface_normals(depth: Float[Tensor, "b t h w"], focal: Float[Tensor, "b"]) -> Float[Tensor, "b t h2 w2 3"]:
    """Unit normals of the surface through the pixels' points, by central differences; one pixel less on each side.

    The principal point is the centre of the image.
    """
    height, width = depth.shape[-2:]
    scale = 1 / focal[:, None, None, None]
    x = (torch.arange(width, device=depth.device, dtype=depth.dtype) + 0.5 - width / 2) * scale
    y = (torch.arange(height, device=depth.device, dtype=depth.dtype) + 0.5 - height / 2)[:, None] * scale
    points = torch.stack([x * depth, y * depth, depth], -1)
    across = points[..., 1:-1, 2:, :] - points[..., 1:-1, :-2, :]
    along = points[..., 2:, 1:-1, :] - points[..., :-2, 1:-1, :]
    normal = torch.linalg.cross(across, along)
    unit: Tensor = normal / (normal.square().sum(-1, keepdim=True) + 1e-20).sqrt()
    return unit


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

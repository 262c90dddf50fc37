"""Temporal consistency: depth edges of neighbouring frames are alike (Eq. 5), and a reading that survives motion."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.losses.photometric import Reduction
from bathyscope_train.losses.warping import FramePairs, meet

SCALES = 4
"""S; not in the paper, four octaves as is usual for gradient losses of depth."""
_FLAT = 1e-4
"""Relative slope per pixel below which a depth map has no edges to speak of."""


def temporal_gradient_loss(
    depth: Float[Tensor, "b t h w"],
    valid: Bool[Tensor, "b t h w"],
    *,
    stride: int = 6,
    scales: int = SCALES,
    reduction: Reduction = "mean",
) -> Float[Tensor, ""]:
    r"""Difference between the depth gradients of two frames, pixel by pixel, as the paper writes it.

    .. math:: \mathcal{L}_{temp} = \frac{1}{N} \sum_{t=1}^{N} \sum_{s=0}^{S-1} \Big(
              \big\| \nabla_x D_t^{(s)} - \nabla_x D_{t+\Delta}^{(s)} \big\|_1 +
              \big\| \nabla_y D_t^{(s)} - \nabla_y D_{t+\Delta}^{(s)} \big\|_1 \Big) \odot \Omega_t

    Readings. N counts the pairs t, t + stride. :math:`\Omega_t` holds pixels valid in both frames. Downsampling by
    :math:`2^s` takes means of whole blocks; a block with an invalid pixel is invalid, and so is a difference with an
    invalid end, so no value ever comes from outside :math:`\Omega`; rows and columns that fill no block are dropped.
    A norm is the *mean* over valid differences (``sum`` adds them up as written, and grows with the resolution).

    This is a length and compares pixels that show different points once the camera moves. Its minimum is then a
    *constant map*, whatever the truth, and shrinking the scene lowers it: see ``docs/consistency-losses.md`` for
    numbers. Use it to reproduce the paper, and :func:`moving_edges_loss` to train.

    Args:
        depth: Rendered z-depth.
        valid: Pixels that count; what is not valid may be anything.
        stride: Distance between the frames of a pair, in frames.
        scales: S.
        reduction: Over differences.

    Raises:
        GeometryError: If the clip is too short to hold one pair, or too small for the scales.
    """
    pairs = FramePairs.apart(depth.shape[1], stride)
    source, target = list(pairs.source), list(pairs.target)
    both = valid[:, source] & valid[:, target]
    mismatch = depth[:, source] - depth[:, target]
    total = depth.new_zeros(both.shape[:2])
    for level, inside in _pyramid(mismatch, both, scales):
        for change, counted in _differences(level, inside):
            size = counted.sum((-2, -1)).clamp_min(1) if reduction == "mean" else 1
            total = total + (change.abs() * counted).sum((-2, -1)) / size
    return total.mean()


def moving_edges_loss(
    depth: Float[Tensor, "b t h w"],
    intrinsics: Float[Tensor, "b t 3 3"],
    world_from_camera: Float[Tensor, "b t 4 4"],
    valid: Bool[Tensor, "b t h w"],
    *,
    stride: int = 6,
    scales: int = SCALES,
    meets: Bool[Tensor, "b p h w"] | None = None,
) -> Float[Tensor, ""]:
    r"""How much of the depth edges of a frame is missing, or new, where its pixels lie in another frame.

    With :math:`A = \log z(X_t(u))`, the depth that the pixels of frame t have in frame :math:`t' = t + \Delta`, and
    :math:`B = \log \hat D_{t'}(u_{t \to t'})`, the depth found there,

    .. math:: \frac{1}{N S} \sum_{t,s} \frac{\sum_\Omega |\nabla A^{(s)} - \nabla B^{(s)}| + \epsilon}
              {\sum_\Omega |\nabla A^{(s)}| + \sum_\Omega |\nabla B^{(s)}| + \epsilon}

    with blocks, differences and :math:`\Omega` as in :func:`temporal_gradient_loss`. It keeps that loss's purpose
    (edges stay with the surface, and do not flicker) without its minimum: points are compared with themselves, so that
    motion costs nothing, and the difference is measured in shares of the edges that are there. Flattening a map by any
    factor changes nothing, and a constant map scores 1, the worst there is. Scene and poses may shrink together.

    Args:
        depth: Rendered z-depth, in the unit of the poses.
        intrinsics: In pixels of the size of ``depth``.
        world_from_camera: Camera poses.
        valid: Pixels that count.
        stride: Distance between the frames of a pair, in frames.
        scales: S.
        meets: A fixed valid set, from :func:`~bathyscope_train.losses.world.meeting_pixels`; pixels of it that land
            outside are compared with the border, and those without depth, or behind the camera, count as 1.

    Returns:
        From 0, all edges stay, to 1.

    Raises:
        GeometryError: If the clip is too short to hold one pair, or too small for the scales.
    """
    pairs = FramePairs.apart(depth.shape[1], stride)
    met = meet(depth, intrinsics, world_from_camera, valid, pairs)
    counted = met.lands if meets is None else meets
    used = counted & met.found & (met.expected > 0)
    one = depth.new_ones(())
    expected, observed = met.expected.where(used, one).log(), met.observed.where(used, one).log()
    levels = zip(_pyramid(expected, used, scales), _pyramid(observed, used, scales), strict=True)
    share = torch.stack([_changed_share(a, b, inside) for (a, inside), (b, _) in levels]).mean(0)
    kept = used.sum((-2, -1)) / counted.sum((-2, -1)).clamp_min(1)
    return (1 - kept * (1 - share)).mean()


def _changed_share(
    a: Float[Tensor, "b p h w"], b: Float[Tensor, "b p h w"], inside: Bool[Tensor, "b p h w"]
) -> Float[Tensor, "b p"]:
    """How much the slopes of two maps differ, against how much slope there is; 1 where there is none."""
    changed = present = room = a.new_zeros(a.shape[:2])
    for (in_a, counted), (in_b, _) in zip(_differences(a, inside), _differences(b, inside), strict=True):
        changed = changed + ((in_a - in_b).abs() * counted).sum((-2, -1))
        present = present + ((in_a.abs() + in_b.abs()) * counted).sum((-2, -1))
        room = room + counted.sum((-2, -1))
    flat = _FLAT * room.clamp_min(1)
    return (changed + flat) / (present + flat)


def _pyramid(
    values: Float[Tensor, "b n h w"], inside: Bool[Tensor, "b n h w"], scales: int
) -> list[tuple[Tensor, Tensor]]:
    """Values and their validity at every scale; 0 where not valid."""
    levels = []
    values = values.where(inside, values.new_zeros(()))
    for scale in range(scales):
        if scale:
            values = F.avg_pool2d(values, 2)
            inside = F.avg_pool2d(inside.to(values.dtype), 2) > 1 - 1e-4
            values = values.where(inside, values.new_zeros(()))
        levels.append((values, inside))
    return levels


def _differences(values: Tensor, inside: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Finite differences along x and y, and where both ends are valid."""
    return (
        (values[..., 1:] - values[..., :-1], inside[..., 1:] & inside[..., :-1]),
        (values[..., 1:, :] - values[..., :-1, :], inside[..., 1:, :] & inside[..., :-1, :]),
    )

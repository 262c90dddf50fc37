"""World-coordinate consistency between frames of one clip (Eqs. 3 and 4)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bathyscope_train.losses.photometric import Reduction, mean_of_frames, over_frames
from bathyscope_train.losses.warping import FramePairs, Meeting, meet

LOST = 1.0
"""What a pixel of a fixed valid set counts as, in the unit of the residual, if it has or finds no depth."""
_NEAREST_SHARE = 1e-2


def world_consistency_loss(
    depth: Float[Tensor, "b t h w"],
    intrinsics: Float[Tensor, "b t 3 3"],
    world_from_camera: Float[Tensor, "b t 4 4"],
    valid: Bool[Tensor, "b t h w"],
    *,
    stride: int = 6,
    delta: float = 0.1,
    scale_free: bool = True,
    both_ways: bool = False,
    reduction: Reduction = "sum",
    meets: Bool[Tensor, "b p h w"] | None = None,
) -> Float[Tensor, ""]:
    r"""Huber distance between depths that should be those of one surface point.

    A pixel :math:`u` of frame :math:`t` is lifted to the world, moved into frame :math:`t' = t + \Delta`, and its
    z-depth there is compared with the depth rendered where it lands:

    .. math:: \mathcal{L}_{3D} = \sum_{t,t'} \frac{1}{|\Omega_{t,t'}|} \sum_{u \in \Omega_{t,t'}}
              \rho\big(\hat D_{t'}(u_{t \to t'}) - z(X_t(u))\big)

    Readings. The paper's "depth along the ray" is z-depth, which Eq. 3 unprojects. Pairs go forwards, t to t + stride
    (``both_ways`` adds the way back); they are *summed* as written (``mean`` divides by their number), each a mean
    over its :math:`\Omega`. :math:`\Omega` keeps valid pixels with depth that land ahead of the camera between four
    valid pixels of the target; a pair with none adds zero. Occlusions are left to :math:`\rho`, whose turning point
    the paper does not give.

    *Scale.* As written the loss is a length: shrinking scene and poses together lowers it, and a network that solves
    poses from its own depth finds that out. With ``scale_free`` the residual is :math:`\log \hat D_{t'} - \log z`, the
    relative difference to first order: shrinking everything changes neither the loss nor (along that direction) its
    gradient, while depth that does not fit the poses still costs.

    *Escape.* A pixel that leaves the target drops out of :math:`\Omega`, so pushing bad pixels over the border lowers
    the mean. With ``meets``, worked out by :func:`meeting_pixels` from geometry that is not being trained, the set is
    fixed: a pixel of it that lands outside is compared with the nearest pixel of the border, one behind the camera
    with the line that continues the logarithm, and one that has or finds no depth counts as :data:`LOST`.

    Args:
        depth: Rendered z-depth, in the unit of the poses; 0 where nothing was rendered.
        intrinsics: In pixels of the size of ``depth``.
        world_from_camera: Camera poses; frame 0 is the identity.
        valid: Pixels that count: inside the field of view, and solid enough to have a depth.
        stride: Distance between the frames of a pair, in frames.
        delta: Where the Huber penalty turns linear: relative if ``scale_free``, else in the unit of ``depth``. Not in
            the paper.
        scale_free: Compare logarithms instead of lengths.
        both_ways: Also pairs from t + stride to t.
        reduction: Over pairs; the mean is taken over clips.
        meets: A fixed valid set.

    Raises:
        GeometryError: If the clip is too short to hold one pair.
    """
    pairs = FramePairs.apart(depth.shape[1], stride, both_ways=both_ways)
    met = meet(depth, intrinsics, world_from_camera, valid, pairs)
    counted = met.lands if meets is None else meets
    residual = _residual(met, counted & met.found, depth[:, list(pairs.source)], scale_free=scale_free)
    residual = residual.where(met.found, residual.new_full((), LOST))
    penalty = F.huber_loss(residual, torch.zeros_like(residual), delta=delta, reduction="none")
    return over_frames(mean_of_frames(penalty, counted), reduction)


@torch.no_grad()
def meeting_pixels(
    depth: Float[Tensor, "b t h w"],
    intrinsics: Float[Tensor, "b t 3 3"],
    world_from_camera: Float[Tensor, "b t 4 4"],
    valid: Bool[Tensor, "b t h w"],
    *,
    stride: int = 6,
    both_ways: bool = False,
) -> Bool[Tensor, "b p h w"]:
    """The valid set of :func:`world_consistency_loss` for some geometry, say that of the network before training."""
    pairs = FramePairs.apart(depth.shape[1], stride, both_ways=both_ways)
    return meet(depth, intrinsics, world_from_camera, valid, pairs).lands


def _residual(met: Meeting, used: Tensor, source: Tensor, *, scale_free: bool) -> Float[Tensor, "b p h w"]:
    """Observed less expected depth, 0 where it is not used; numbers there never reach the gradient."""
    one = source.new_ones(())
    expected, observed = met.expected.where(used, one), met.observed.where(used, one)
    if not scale_free:
        return observed - expected
    least = _NEAREST_SHARE * source.detach().where(used, one)
    return observed.log() - _continued_log(expected, least)


def _continued_log(values: Float[Tensor, "*n"], least: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The logarithm, and below ``least`` the line that continues it."""
    high = torch.maximum(values, least)
    return high.log() + (torch.minimum(values, least) - least) / least

"""EndoDAV's two losses between adjacent frames of a clip, beside those of EndoDAC."""

from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.losses.corner_warping import reproject, sample, warp_by_flow
from bathyscope_train.losses.resemblance import masked_average
from bathyscope_train.model.unprojection import invert_rigid

_LEAST_DEPTH = 1e-3


def depth_reprojection_loss(
    depth: Float[Tensor, "b t h w"],
    next_from_frame: Float[Tensor, "b p 4 4"],
    intrinsics: Float[Tensor, "b 3 3"],
) -> Float[Tensor, ""]:
    r"""Depth of a frame, moved into its neighbour, against the neighbour's own depth there; both directions averaged.

    .. math:: \frac{1}{2} \sum_{t' = t \pm 1} \Big\langle \big| z(T_{t' \leftarrow t} X_t(u)) - D_{t'}(u') \big|
              \Big\rangle_{D_{t'}(u') > 10^{-3}}

    This is the two-frame, stride 1, L1 relative of the world-coordinate consistency of the paper. Sampling is bilinear
    with zeros outside, so that a pixel that leaves the neighbour drops out; one that leaves it by less than a pixel is
    compared with depth that has zeros blended in, as published.

    Args:
        depth: Predicted z-depth of every frame.
        next_from_frame: Predicted motion of each of the p = t - 1 adjacent pairs; maps points of frame i to i + 1.
        intrinsics: In pixels, shared by the clip.

    Raises:
        GeometryError: If the clip has fewer than two frames, or motions do not match it.
    """
    earlier, later = _pairs(depth, next_from_frame.shape[1])
    forward, matrices = next_from_frame.flatten(0, 1), intrinsics[:, None].expand(-1, depth.shape[1] - 1, 3, 3)
    shared = matrices.flatten(0, 1)
    there = _reprojection_error(earlier, later, forward, shared)
    back = _reprojection_error(later, earlier, invert_rigid(forward), shared)
    return (there + back) / 2


def depth_flow_loss(
    depth: Float[Tensor, "b t h w"],
    flow_to_next: Float[Tensor, "b p 2 h w"],
    flow_to_previous: Float[Tensor, "b p 2 h w"],
) -> Float[Tensor, ""]:
    r"""A neighbour's depth, sampled along the optical flow, against the frame's own; both directions averaged.

    .. math:: \frac{1}{2} \sum_{t' = t \pm 1} \big\langle \big| D_{t'}(u + f_{t \to t'}(u)) - D_t(u) \big| \big\rangle

    The depth of a point is taken to be the same in both frames, which is right for slow motion only.

    Args:
        depth: Predicted z-depth of every frame.
        flow_to_next: Of frames 0 to t - 2, in pixels, channels in the order (y, x).
        flow_to_previous: Of frames 1 to t - 1.

    Raises:
        GeometryError: If the clip has fewer than two frames, or flows do not match it.
    """
    earlier, later = _pairs(depth, flow_to_next.shape[1])
    _pairs(depth, flow_to_previous.shape[1])
    there = (warp_by_flow(later[:, None], flow_to_next.flatten(0, 1))[:, 0] - earlier).abs().mean()
    back = (warp_by_flow(earlier[:, None], flow_to_previous.flatten(0, 1))[:, 0] - later).abs().mean()
    return (there + back) / 2


def _pairs(depth: Tensor, pairs: int) -> tuple[Tensor, Tensor]:
    """Depth of the first and of the second frame of every adjacent pair, all clips in one batch."""
    frames = depth.shape[1]
    if frames < 2 or pairs != frames - 1:
        raise GeometryError(
            f"{frames} frames have {max(frames - 1, 0)} adjacent pairs, at least 1 is needed; got {pairs}"
        )
    return depth[:, :-1].flatten(0, 1), depth[:, 1:].flatten(0, 1)


def _reprojection_error(
    depth: Float[Tensor, "n h w"],
    other: Float[Tensor, "n h w"],
    other_from_frame: Float[Tensor, "n 4 4"],
    intrinsics: Float[Tensor, "n 3 3"],
) -> Float[Tensor, ""]:
    pixels, expected = reproject(depth, other_from_frame, intrinsics)
    observed = sample(other[:, None], pixels, padding="zeros")
    valid = (observed > _LEAST_DEPTH).to(depth.dtype)
    return masked_average((expected[:, None] - observed).abs(), valid)

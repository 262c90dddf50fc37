"""The two objectives of EndoDAC, which are stepped in turn on every batch.

Frames are a target (0) and its sources (-1, +1). A flow network and an appearance network explain what a rigid scene
with one light does not; depth, pose and intrinsics explain the rest. Everything is given at full size, for one of the
four scales; the objective of a batch is the mean over scales. There is no automatic mask and no minimum over sources.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.losses.resemblance import masked_average, photometric_error
from bathyscope_train.losses.smoothness import appearance_smoothness, disparity_smoothness, edge_aware_smoothness

FLOW_SMOOTHNESS = 1e-3
DISPARITY_SMOOTHNESS = 1e-3
FLOW_AGREEMENT = 0.01
APPEARANCE_SMOOTHNESS = 0.01


@dataclass(frozen=True, slots=True)
class SourceView:
    """What flow and appearance say of one source, at the target's size."""

    by_flow: Float[Tensor, "n 3 h w"]
    """The source warped by the optical flow (:func:`~bathyscope_train.losses.corner_warping.warp_by_flow`)."""
    flow: Float[Tensor, "n 2 h w"]
    """That flow."""
    visible: Float[Tensor, "n 1 h w"]
    """Where the source sees the target (:func:`~bathyscope_train.losses.occlusion.visibility_mask`)."""
    appearance: Float[Tensor, "n 3 h w"]
    """Predicted change of colour."""


def refined_target(target: Float[Tensor, "n 3 h w"], view: SourceView) -> Float[Tensor, "n 3 h w"]:
    """The target as the source's light shows it: ``clamp(target + visible * appearance, 0, 1)``."""
    return (target + view.visible * view.appearance).clamp(0, 1)


def flow_objective(target: Float[Tensor, "n 3 h w"], views: Sequence[SourceView], *, scale: int) -> Float[Tensor, ""]:
    r"""What trains the flow network, alone. Refined targets :math:`\tilde I_s` receive no gradient.

    .. math:: \frac{1}{S} \sum_s \langle pe(I_s^{flow}, \tilde I_s) \rangle_{M_s}
              + 10^{-3}\, 2^{-k} \frac{1}{S} \sum_s smooth(f_s)

    Args:
        target: The target frame.
        views: One for each of the S sources.
        scale: The scale k, 0 the finest.

    Raises:
        GeometryError: If there is no source.
    """
    _need_views(views)
    losses = []
    for view in views:
        with torch.no_grad():
            refined = refined_target(target, view)
        match = masked_average(photometric_error(view.by_flow, refined), view.visible)
        losses.append(match + FLOW_SMOOTHNESS / float(2**scale) * edge_aware_smoothness(view.flow, target))
    return torch.stack(losses).mean()


def depth_objective(
    target: Float[Tensor, "n 3 h w"],
    disparity: Float[Tensor, "n 1 h2 w2"],
    views: Sequence[SourceView],
    by_depth: Sequence[Float[Tensor, "n 3 h w"]],
    *,
    scale: int,
    edges: Float[Tensor, "n 3 h2 w2"] | None = None,
) -> Float[Tensor, ""]:
    r"""What trains depth, pose, intrinsics and appearance.

    .. math:: \frac{1}{S} \sum_s \Big[ \langle pe(I_s^{depth}, \tilde I_s) \rangle_{M_s}
              + 0.01 \langle |\tilde I_s - I_s^{flow}| \rangle_{M_s}
              + 0.01\, smooth_{M_s}(a_s \mid I - I_s^{flow}) \Big]
              + 10^{-3}\, 2^{-k} smooth(d / \bar d)

    Args:
        target: The target frame.
        disparity: Of the target, at any size.
        views: One for each of the S sources.
        by_depth: These sources warped by depth, motion and intrinsics
            (:func:`~bathyscope_train.losses.corner_warping.warp_by_depth`).
        scale: The scale k, 0 the finest.
        edges: The target at the size of ``disparity``, where that is another than the target's own.

    Raises:
        GeometryError: If there is no source.
    """
    _need_views(views)
    losses = []
    for view, warped in zip(views, by_depth, strict=True):
        refined, flowed = refined_target(target, view), view.by_flow.detach()
        match = masked_average(photometric_error(warped, refined), view.visible)
        agree = masked_average((refined - flowed).abs(), view.visible)
        smooth = appearance_smoothness(view.appearance, target - flowed, view.visible)
        losses.append(match + FLOW_AGREEMENT * agree + APPEARANCE_SMOOTHNESS * smooth)
    smooth = disparity_smoothness(disparity, target if edges is None else edges)
    weight = DISPARITY_SMOOTHNESS / float(2**scale)
    return torch.stack(losses).mean() + weight * smooth


def _need_views(views: Sequence[SourceView]) -> None:
    if not views:
        raise GeometryError("the objective compares a target with its sources, got none; give the frames beside it")

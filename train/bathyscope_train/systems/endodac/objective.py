"""From frames and their disparities to EndoDAC's two objectives, through all of its networks."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope.depth_range import DepthRange
from bathyscope.errors import GeometryError
from bathyscope_train.losses.corner_warping import warp_by_depth, warp_by_flow
from bathyscope_train.losses.endodac import SourceView, depth_objective, flow_objective
from bathyscope_train.losses.occlusion import visibility_mask
from bathyscope_train.model.dense_head import resize_bilinear
from bathyscope_train.systems.endodac.flow_decoder import SCALES
from bathyscope_train.systems.endodac.pose import average_intrinsics
from bathyscope_train.systems.endodac.training import TrainingNetworks

_COARSEST = 32
"""Pixels of a frame along a side of the coarsest features' pixel."""


class EndoDacObjective:
    """The two losses of a batch, each of which is followed by a step of its own optimiser.

    All scales are brought to the size of the frames (bilinear, corners aligned) before they are compared. The
    appearance network reads the source warped by the finest flow, and the target, in this order: not stated anywhere.

    Args:
        networks: Pose, intrinsics, flow and appearance.
        depth_range: What a disparity means.
    """

    def __init__(self, networks: TrainingNetworks, depth_range: DepthRange | None = None) -> None:
        self.networks, self.depth_range = networks, depth_range or DepthRange()

    def flow(self, target: Float[Tensor, "n 3 h w"], sources: Sequence[Float[Tensor, "n 3 h w"]]) -> Float[Tensor, ""]:
        """What trains the flow network.

        Args:
            target: Frames in [0, 1], sides multiples of 32 and at least 64.
            sources: The frames before and after each.

        Raises:
            GeometryError: If there are no sources, or the networks cannot take frames of this size.
        """
        views = [self.views(target, source) for source in sources]
        losses = [flow_objective(target, [each[scale] for each in views], scale=scale) for scale in range(SCALES)]
        return torch.stack(losses).mean()

    def scene(
        self,
        disparities: Sequence[Float[Tensor, "n 1 h2 w2"]],
        target: Float[Tensor, "n 3 h w"],
        sources: Sequence[Float[Tensor, "n 3 h w"]],
    ) -> Float[Tensor, ""]:
        """What trains depth, pose, intrinsics and appearance.

        Args:
            disparities: Of the target, at every scale, fine to coarse, as a depth network gives them.
            target: As of :meth:`flow`.
            sources: As of :meth:`flow`.

        Raises:
            GeometryError: As :meth:`flow`.
        """
        views = [self.views(target, source) for source in sources]
        motions = [self.motion(source, target) for source in sources]
        losses = []
        for scale, disparity in enumerate(disparities):
            depth = self.depth_of(disparity, target)
            warped = [
                warp_by_depth(source, depth, matrix, intrinsics)
                for source, (matrix, intrinsics) in zip(sources, motions, strict=True)
            ]
            edges = F.adaptive_avg_pool2d(target, _size(disparity))
            at_scale = [each[scale] for each in views]
            losses.append(depth_objective(target, disparity, at_scale, warped, scale=scale, edges=edges))
        return torch.stack(losses).mean()

    def depth_of(self, disparity: Float[Tensor, "n 1 h2 w2"], frames: Float[Tensor, "n 3 h w"]) -> Tensor:
        """Depth (n, h, w) at the size of the frames."""
        return self.depth_range.depth(resize_bilinear(disparity, _size(frames))[:, 0])

    def views(self, target: Float[Tensor, "n 3 h w"], source: Float[Tensor, "n 3 h w"]) -> list[SourceView]:
        """What flow and appearance say of a source, at every scale."""
        _check_size(target)
        flows, reverse = self.flows(source, target), self.flows(target, source)
        by_flow = [warp_by_flow(source, flow) for flow in flows]
        features = self.networks.transform_encoder(by_flow[0].detach(), target)
        changes = _at_full_size(self.networks.transform(features), target)
        return [
            SourceView(warped, flow, visibility_mask(back), change)
            for warped, flow, back, change in zip(by_flow, flows, reverse, changes, strict=True)
        ]

    def flows(self, source: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        """From the target's pixels to where they are in the source (n, 2, h, w), at every scale."""
        return _at_full_size(self.networks.position(self.networks.position_encoder(source, target)), target)

    def motion(self, source: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, Tensor]:
        """Source from target (n, 4, 4), and the intrinsics (n, 3, 3) that the pair tells."""
        motion = self.networks.pose(self.networks.pose_encoder(source, target)[-1])
        if self.networks.intrinsics_head is not None:
            return motion.matrix(), self.networks.intrinsics_head(motion.features, _size(target))
        return motion.matrix(), average_intrinsics(_size(target)).to(target).expand(target.shape[0], 3, 3)


def _at_full_size(scales: Sequence[Tensor], like: Tensor) -> list[Tensor]:
    return [resize_bilinear(maps, _size(like)) for maps in scales]


def _size(frames: Tensor) -> tuple[int, int]:
    return frames.shape[-2], frames.shape[-1]


def _check_size(frames: Tensor) -> None:
    """Skips need whole multiples, and reflection at the border two pixels of the coarsest map."""
    height, width = _size(frames)
    if height % _COARSEST or width % _COARSEST or min(height, width) < 2 * _COARSEST:
        raise GeometryError(
            f"frames of {height}x{width}; sides must be multiples of {_COARSEST}, {2 * _COARSEST} or more; resize them"
        )

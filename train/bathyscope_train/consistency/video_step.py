"""One step forward for a video network, which has no cameras: they are another system's, or the data's."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bathyscope_train.consistency.clip_step import FLAT, GROWTH, TOTAL, VARIATION, within_frame_variation
from bathyscope_train.consistency.geometry import ClipGeometry
from bathyscope_train.consistency.objective import consistency_terms, weighted_sum
from bathyscope_train.consistency.rendering import ClipRendering, placed_depth
from bathyscope_train.consistency.settings import ConsistencySettings
from bathyscope_train.systems.camera_sources import ClipCameras
from bathyscope_train.systems.vda.training import VdaGeometry


class VideoStep(nn.Module):
    """The network in training, the network as it was, and L_3D and L_temp between them.

    Called like :class:`~bathyscope_train.consistency.clip_step.ClipStep`, with cameras in the place of focal lengths.

    Args:
        geometry: The network in training, and what makes depth of its values.
        settings: Of the run; the image term has no weight.
    """

    def __init__(self, geometry: VdaGeometry, settings: ConsistencySettings) -> None:
        super().__init__()
        self.geometry = geometry
        self.before = geometry.frozen_copy()
        self.settings = settings
        self.weights: dict[str, float] = settings.loss.weights

    def forward(
        self,
        images: Float[Tensor, "b t 3 h w"],
        inside: Bool[Tensor, "b h w"],
        known: ClipCameras | None = None,
        progress: float = 1.0,
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms by name, and with them their weighted sum, the variation of depth and its growth."""
        geometry, before = self.geometries(images, inside, known)
        rendered = placed_depth(geometry)
        terms = consistency_terms(
            rendered, geometry, before, images=images, inside=inside, settings=self.settings.loss, progress=progress
        )
        with torch.no_grad():
            started = within_frame_variation(before.depth, inside).clamp_min(FLAT)
            variation = within_frame_variation(geometry.depth, inside) / started
            growth = (geometry.depth / before.depth).log().mean()
        return {TOTAL: weighted_sum(terms, self.weights), **terms, VARIATION: variation, GROWTH: growth}

    def geometries(
        self, images: Tensor, inside: Tensor, known: ClipCameras | None
    ) -> tuple[ClipGeometry, ClipGeometry]:
        """Of the network as it is, and as it was before training, with the same cameras."""
        cameras = known if known is not None else self.geometry.borrowed(images)
        with torch.no_grad():
            before = self.before(images, inside, cameras)
        return self.geometry(images, inside, cameras), before

    @torch.no_grad()
    def look(self, images: Tensor, inside: Tensor, known: ClipCameras | None = None) -> ClipRendering:
        """Depth of clips, for pictures."""
        cameras = known if known is not None else self.geometry.borrowed(images)
        return placed_depth(self.geometry(images, inside, cameras))

    def weigh(self, weights: Mapping[str, float]) -> None:
        """Replace the factors of the terms."""
        self.weights = dict(weights)

"""From a clip to EndoDAV's objective: EndoDAC's for each frame with two neighbours, and adjacent depths that agree."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from bathyscope.errors import GeometryError
from bathyscope_train.losses.endodav import depth_flow_loss, depth_reprojection_loss
from bathyscope_train.systems.endodac.objective import EndoDacObjective
from bathyscope_train.systems.endodav.network import EndoDav

_SHORTEST = 3


@dataclass(frozen=True, slots=True)
class AgreementWeights:
    """Weights of the losses between adjacent frames, which count in temporal turns only."""

    reprojection: float = 1e-3
    """The public scripts have 1e-4 to 1e-2."""
    flow: float = 0.0
    """Not stated."""


class EndoDavObjective:
    """The losses of clips.

    Args:
        network: The depth network.
        endodac: EndoDAC's objectives, for the same :attr:`~EndoDavSettings.depth_range`.
        weights: Of what EndoDAV adds.
    """

    def __init__(self, network: EndoDav, endodac: EndoDacObjective, weights: AgreementWeights | None = None) -> None:
        self.network, self.endodac, self.weights = network, endodac, weights or AgreementWeights()

    def flow(self, clips: Float[Tensor, "b t 3 h w"]) -> Float[Tensor, ""]:
        """What trains the flow network; see :meth:`EndoDacObjective.flow`.

        Raises:
            GeometryError: If a clip has fewer than three frames, or the networks cannot take frames of this size.
        """
        target, sources = _neighbours(clips)
        return self.endodac.flow(target, sources)

    def scene(self, clips: Float[Tensor, "b t 3 h w"], *, agreement: bool) -> Float[Tensor, ""]:
        """What trains everything else.

        Args:
            clips: Frames in [0, 1], sides multiples of 32 and at least 64.
            agreement: Whether the losses between adjacent frames count: in temporal turns.

        Raises:
            GeometryError: As :meth:`flow`.
        """
        target, sources = _neighbours(clips)
        disparities = self.network(clips)
        inner = [maps.unflatten(0, clips.shape[:2])[:, 1:-1].flatten(0, 1) for maps in disparities]
        loss = self.endodac.scene(inner, target, sources)
        return loss + self._agreement(clips, disparities[0]) if agreement else loss

    def _agreement(self, clips: Tensor, disparity: Tensor) -> Tensor:
        """Losses between adjacent frames; one camera serves the clip, the mean of what its pairs tell."""
        shape = clips.shape[:2]
        depth = self.endodac.depth_of(disparity, clips.flatten(0, 1)).unflatten(0, shape)
        earlier, later = clips[:, :-1].flatten(0, 1), clips[:, 1:].flatten(0, 1)
        pairs = (shape[0], shape[1] - 1)
        next_from_frame, intrinsics = self.endodac.motion(later, earlier)
        camera = intrinsics.unflatten(0, pairs).mean(1)
        weights = self.weights
        total = weights.reprojection * depth_reprojection_loss(depth, next_from_frame.unflatten(0, pairs), camera)
        if weights.flow:
            to_next = self.endodac.flows(later, earlier)[0].detach().unflatten(0, pairs)
            to_previous = self.endodac.flows(earlier, later)[0].detach().unflatten(0, pairs)
            total = total + weights.flow * depth_flow_loss(depth, to_next, to_previous)
        return total


def _neighbours(clips: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Every frame with two neighbours, as a target, and those before and after, as its sources."""
    if clips.shape[1] < _SHORTEST:
        raise GeometryError(f"a clip of {clips.shape[1]} frames; {_SHORTEST} are needed for one with two neighbours")
    return clips[:, 1:-1].flatten(0, 1), [clips[:, :-2].flatten(0, 1), clips[:, 2:].flatten(0, 1)]

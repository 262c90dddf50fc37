"""Points are seen where depth and motion put them; not in the paper."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from bathyscope_train.model.matching_camera_head import PlacedMatches
from bathyscope_train.model.pose_layer import project


def matches_loss(seen: PlacedMatches, *, delta: float = 0.5) -> Float[Tensor, ""]:
    r"""Huber distance between where a point is and where the matcher saw it, in cells of 4 pixels.

    .. math:: \mathcal{L}_{match} = \frac{1}{\sum w} \sum_{(s, t)} \sum_q
              w_q \, \rho_\delta\big(\pi(R_{st} X_s(q) + t_{st}) - m_{st}(q)\big)

    :math:`X_s(q)` is query q of frame s at its predicted depth, :math:`(R, t)` the motion that fits the matches
    :math:`m` best at this depth, and w the trust in them; coordinates count by themselves. What no motion of a rigid
    camera explains is left, and it is left to the depth.

    It is the counterpart of the photometric term, with correspondences that were learnt instead of colours that must
    stay, and it is what keeps the world term honest where cameras are solved from depth: depth that is flattened
    together with a camera that stands still agrees with itself, but not with what was seen to move.

    Matches, trust and motion have no gradient. For the motion this is exact to first order, since it minimises (the
    square of) the same distance. Scene and motion may shrink together: lengths are in units of the clip's mean depth.

    Args:
        seen: From a camera head whose cameras are taken as given.
        delta: Where the Huber penalty turns linear, in cells.
    """
    distance = project(seen.points, seen.motion, seen.focal) - seen.matches
    penalty = F.huber_loss(distance, torch.zeros_like(distance), delta=delta, reduction="none")
    return (seen.trust * penalty).sum() / seen.trust.sum().clamp_min(1)

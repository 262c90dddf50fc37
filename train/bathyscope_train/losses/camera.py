"""Supervised cameras: motions of pairs, the flow that they induce, and the focal length."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from bathyscope_train.losses.matching import TrueMatches, flow_loss
from bathyscope_train.model.pose_layer import Motion, project
from bathyscope_train.model.rigid import antisymmetric_part, trace

_TRANSLATION_WEIGHT = 0.1
_STILL = 0.1


def motion_loss(motion: Motion, true: Motion) -> Float[Tensor, ""]:
    """Mean over pairs of |sin| + 2 (1 - cos) of the rotation error, plus a tenth of the relative translation error.

    With dR = R R*^T of angle a the first two terms are |vee(dR)| = |sin a| and 3 - tr dR = 2 (1 - cos a): steep near
    zero and still rising beyond a right angle. The translation error is divided by |t*| + 0.1, lengths in units of
    the clip's mean depth.
    """
    turn = motion.rotation @ true.rotation.transpose(-1, -2)
    rotation = length(antisymmetric_part(turn)) + 3 - trace(turn)
    translation = length(motion.translation - true.translation) / (length(true.translation) + _STILL)
    return (rotation + _TRANSLATION_WEIGHT * translation).mean()


def induced_flow_loss(motion: Motion, true: TrueMatches) -> Float[Tensor, ""]:
    """Distance in cells between where a motion and the true one carry the true points, seen without distortion."""
    return flow_loss(project(true.points, motion, true.focal), replace(true, positions=true.ideal))


def focal_loss(focal: Float[Tensor, "b"], true: Float[Tensor, "b"]) -> Float[Tensor, ""]:
    """Mean absolute difference of the logarithms."""
    return (focal.log() - true.log()).abs().mean()


def length(vector: Float[Tensor, "*n k"]) -> Float[Tensor, "*n"]:
    """Euclidean length with a finite gradient at zero."""
    return (vector.square().sum(-1) + 1e-12).sqrt()

"""Camera head of the tiny preset: cameras from matches, predicted depth and a least-squares solver.

A camera token alone does not learn motion from a few thousand examples. Correspondences do: they are
supervised densely, and the step from them to a motion is known geometry (:mod:`.pose_layer`). The field of
view comes from the camera tokens.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from bathyscope_train.model.correspondence import (
    Correlation,
    Matcher,
    MatchingEncoder,
    MatchingFeatures,
    query_depth,
)
from bathyscope_train.model.pose_encoding import matrix_to_quaternion
from bathyscope_train.model.pose_layer import Motion, Solution, project, rays, solve_motion
from bathyscope_train.model.stem import CELL
from bathyscope_train.model.trajectory import clip_pairs, fuse_trajectory

_TYPICAL_FOCAL = 0.45
_OUTSIDE = 4.0


@dataclass(frozen=True, slots=True)
class Round:
    """One look at the matches and the motion it gives."""

    matches: Float[Tensor, "e q 2"]
    """In cells from the principal point of the target frame."""
    trust: Float[Tensor, "e q 2"]
    solution: Solution


@dataclass(frozen=True, slots=True)
class PairEstimates:
    """Motions of pairs of frames, and how they came about (which training supervises)."""

    correlation: Correlation
    principal: Float[Tensor, "2"]
    """Principal point, in cells."""
    rounds: tuple[Round, ...]

    @property
    def solution(self) -> Solution:
        """The last round's motions."""
        return self.rounds[-1].solution


class FocalHead(nn.Module):
    """Focal length of a clip, in units of the image diagonal, from its camera tokens."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=1e-5)
        self.hidden = nn.Linear(width, width // 4)
        self.readout = nn.Linear(width // 4, 1)
        nn.init.normal_(self.readout.weight, std=0.01)
        nn.init.zeros_(self.readout.bias)

    def forward(self, camera_tokens: Float[Tensor, "b t c"]) -> Float[Tensor, "b"]:
        logarithm: Tensor = self.readout(F.gelu(self.hidden(self.norm(camera_tokens)))).mean((1, 2))
        return _TYPICAL_FOCAL * logarithm.clamp(-3, 3).exp()


class MatchingCameraHead(nn.Module):
    """Pose encodings of a clip from its features and predicted depth.

    Args:
        width: Channels of a camera token and of a tapped token.
        stem_channels: Channels of the stem's quarter-size map.
        patch_size: Side of a patch in pixels.
        rounds: How often matches are looked up and the motion is solved.
        iterations: Solver iterations a round.
    """

    def __init__(
        self, width: int, *, stem_channels: int, patch_size: int = 14, rounds: int = 2, iterations: int = 3
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.rounds = rounds
        self.iterations = iterations
        self.focal = FocalHead(width)
        self.encoder = MatchingEncoder(width, stem_channels)
        self.matcher = Matcher()

    def forward(
        self,
        camera_tokens: Float[Tensor, "b t c"],
        tokens: Float[Tensor, "b t n c"],
        stem_maps: Sequence[Float[Tensor, "b t k gh gw"]],
        depth: Float[Tensor, "b t h w"],
    ) -> Float[Tensor, "1 b t 9"]:
        """Pose encodings; camera 0 is the identity, lengths are in the unit of ``depth``."""
        b, t, height, width = depth.shape
        focal = self.focal(camera_tokens) * image_diagonal(height, width, like=depth)
        source, target = clip_pairs(t, depth.device)
        scale = depth.mean((1, 2, 3))
        solution = self.estimate(
            self.features(tokens, stem_maps, (height, width)),
            depth / scale[:, None, None, None],
            focal,
            source,
            target,
        ).solution
        pairs = Motion(
            solution.motion.rotation.unflatten(0, (b, 3 * t)), solution.motion.translation.unflatten(0, (b, 3 * t))
        )
        trajectory = fuse_trajectory(pairs, solution.information.unflatten(0, (b, 3 * t)))
        fields = [2 * torch.atan(0.5 * side / focal) for side in (height, width)]
        encoding = [
            trajectory.translation * scale[:, None, None],
            matrix_to_quaternion(trajectory.rotation),
            torch.stack(fields, -1)[:, None].expand(b, t, 2),
        ]
        return torch.cat(encoding, -1)[None]

    def features(
        self, tokens: Float[Tensor, "b t n c"], stem_maps: Sequence[Tensor], size: tuple[int, int]
    ) -> MatchingFeatures:
        """Matching features of images of ``size``."""
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        features: MatchingFeatures = self.encoder(stem_maps[-1], tokens, grid)
        return features

    def estimate(
        self,
        features: MatchingFeatures,
        depth: Float[Tensor, "b t h w"],
        focal: Float[Tensor, "b"],
        source: Int[Tensor, "p"],
        target: Int[Tensor, "p"],
    ) -> PairEstimates:
        """Motions of p pairs of frames of each clip (e = b p, clip-major).

        Args:
            features: From :meth:`features`.
            depth: Z-depth with clip mean about 1.
            focal: Focal length in pixels.
            source: Frames that the motions start from.
            target: Frames that they lead to.
        """
        height, width = depth.shape[-2:]
        pairs = source.shape[0]
        cells = (focal / CELL)[:, None].expand(-1, pairs).flatten()
        correlation = self.matcher.correlate(
            features.descriptors[:, source].flatten(0, 1), features.descriptors[:, target].flatten(0, 1)
        )
        context = features.context[:, source].flatten(0, 1)
        distance = query_depth(depth)[:, source].flatten(0, 1)
        principal = _principal_point(height, width, like=depth)
        centred = correlation.queries - principal
        points = (
            rays(centred.expand(distance.shape[0], -1, -1), cells[:, None].expand(distance.shape)) * distance[..., None]
        )
        position = (centred / principal).expand(distance.shape[0], -1, -1)
        motion = Motion.none(points[:, 0])
        base = correlation.best
        rounds = []
        for index in range(self.rounds):
            if index:
                motion = motion.detach()
                low, high = -principal - _OUTSIDE, principal + _OUTSIDE
                base = torch.minimum(torch.maximum(project(points, motion, cells), low), high) + principal
            matches, trust = self.matcher.correct(correlation, base.detach(), context, distance.log(), position)
            matches = matches - principal
            solution = solve_motion(points, matches, trust, cells, motion, iterations=self.iterations)
            motion = solution.motion
            rounds.append(Round(matches, trust, solution))
        return PairEstimates(correlation, principal, tuple(rounds))


def image_diagonal(height: int, width: int, *, like: Tensor) -> Float[Tensor, ""]:
    """Length of the diagonal in pixels."""
    sides = [torch.full((), side, device=like.device, dtype=like.dtype) for side in (height, width)]
    return (sides[0].square() + sides[1].square()).sqrt()


def _principal_point(height: int, width: int, *, like: Tensor) -> Float[Tensor, "2"]:
    """Centre of the image, (x, y) in cells."""
    sides = [torch.full((), side, device=like.device, dtype=like.dtype) for side in (width, height)]
    return torch.stack(sides) / (2 * CELL)

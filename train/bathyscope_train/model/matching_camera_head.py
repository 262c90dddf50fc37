"""Camera head of the small presets: cameras from matches, predicted depth and a least-squares solver.

A camera token alone does not learn motion from a few thousand examples. Correspondences do: they are
supervised densely, and the step from them to a motion is known geometry (:mod:`.pose_layer`). The field of
view begins with what the camera tokens say and is corrected by the motions (:mod:`.focal_layer`), unless the
caller knows it; parallax corrects the depth (:mod:`.depth_refiner`), and the corrected depth the motions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.correspondence import (
    CONTEXT,
    Correlation,
    Matcher,
    MatchingEncoder,
    MatchingFeatures,
    query_centres,
    query_depth,
)
from bathyscope_train.model.depth_refiner import DepthRefiner, parallax, spread_queries
from bathyscope_train.model.focal_layer import focal_step, fuse_focal
from bathyscope_train.model.pose_encoding import matrix_to_quaternion
from bathyscope_train.model.pose_graph import settle_trajectory
from bathyscope_train.model.pose_layer import Motion, Solution, project, rays, solve_motion
from bathyscope_train.model.presets import MatchingCameraSettings
from bathyscope_train.model.stem import CELL
from bathyscope_train.model.trajectory import ClipPairs, clip_pairs, follow_steps, fuse_trajectory

_TYPICAL_FOCAL = 0.45
_OUTSIDE = 4.0
_INITIAL_FOCAL_PRIOR = 3.0  # exp(3) = 20: the first estimate is good to about 22 %


@dataclass(frozen=True, slots=True)
class Clip:
    """What is known of a clip before its motions; lengths in units of its mean depth."""

    features: MatchingFeatures
    size: tuple[int, int]
    principal: Float[Tensor, "2"]
    """Principal point, in cells."""
    queries: Float[Tensor, "q 2"]
    """Queries, in cells from the principal point."""
    depth: Float[Tensor, "b t q"]
    """Predicted depth at the queries."""


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
    rounds: tuple[Round, ...]

    @property
    def last(self) -> Round:
        """The last look."""
        return self.rounds[-1]


@dataclass(frozen=True, slots=True)
class Found:
    """Matches and motions of a clip before its depth is corrected."""

    clip: Clip
    pairs: ClipPairs
    estimates: PairEstimates
    focal: Float[Tensor, "b"]
    """In pixels."""
    scale: Float[Tensor, "b"]
    """Mean of the predicted depth."""


@dataclass(frozen=True, slots=True)
class PlacedMatches:
    """Queries of e pairs of frames where depth and motion put them, and where they were seen."""

    points: Float[Tensor, "e q 3"]
    """In the source camera, in units of the clip's mean depth."""
    matches: Float[Tensor, "e q 2"]
    """Where they were seen in the target frame, in cells from its principal point."""
    trust: Float[Tensor, "e q 2"]
    """0 to 1; 0 for pairs that do not exist."""
    focal: Float[Tensor, "e"]
    """In cells."""
    motion: Motion


@dataclass(frozen=True, slots=True)
class CameraSolution:
    """What the head says about a clip."""

    pose_encodings: Float[Tensor, "i b t 9"]
    """After each iteration of the head; the matching head gives only the final one."""
    depth: Float[Tensor, "b t h w"]
    """The predicted depth, corrected by parallax."""
    seen: PlacedMatches | None = None
    """How well the corrected depth explains the matches; only where cameras are taken as given."""


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
    """Pose encodings and corrected depth of a clip from its features and predicted depth.

    Args:
        width: Channels of a camera token and of a tapped token.
        stem_channels: Channels of the stem's quarter-size map.
        patch_size: Side of a patch in pixels.
        settings: How often matches are looked up and motions are solved.
    """

    def __init__(
        self,
        width: int,
        *,
        stem_channels: int,
        patch_size: int = 14,
        settings: MatchingCameraSettings = MatchingCameraSettings(),
    ) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.settings = settings
        self.focal = FocalHead(width)
        self.focal_prior = nn.Parameter(torch.tensor(_INITIAL_FOCAL_PRIOR))
        self.encoder = MatchingEncoder(width, stem_channels)
        self.matcher = Matcher()
        self.refiner = DepthRefiner(CONTEXT)

    def forward(
        self,
        camera_tokens: Float[Tensor, "b t c"],
        tokens: Float[Tensor, "b t n c"],
        stem_maps: Sequence[Float[Tensor, "b t k gh gw"]],
        depth: Float[Tensor, "b t h w"],
        focal: Float[Tensor, "b"] | None = None,
    ) -> CameraSolution:
        """Cameras and corrected depth; camera 0 is the identity, lengths are in the unit of ``depth``.

        Args:
            camera_tokens: Camera token of each frame.
            tokens: Patch tokens of the last tapped layer.
            stem_maps: Maps of the image stem; the finest is last.
            depth: Predicted depth.
            focal: Known focal length in pixels; where it is 0 (or not given), it is estimated.
        """
        found = self.search(camera_tokens, tokens, stem_maps, depth, focal)
        correction = self.correct_depth(found.clip, found.estimates, found.focal, found.pairs)
        sharper = found.clip.depth * correction.exp()
        solution = self.resolve(found.clip, found.estimates, found.focal, found.pairs, depth=sharper)
        encodings = self.encode(found, solution)
        return CameraSolution(encodings, self.corrected(found.clip, depth, correction))

    def take_as_given(
        self,
        camera_tokens: Float[Tensor, "b t c"],
        tokens: Float[Tensor, "b t n c"],
        stem_maps: Sequence[Float[Tensor, "b t k gh gw"]],
        depth: Float[Tensor, "b t h w"],
        focal: Float[Tensor, "b"] | None = None,
    ) -> CameraSolution:
        """The numbers of :meth:`forward`; gradients reach the depth and its correction, and nothing else.

        Matches, focal length and motions are those of the depth as it is. They minimise what is left of the matches,
        so that to first order they would not answer to a change of the depth anyway.
        """
        with torch.no_grad():
            found = self.search(camera_tokens, tokens, stem_maps, depth, focal)
        clip = replace(found.clip, depth=query_depth(depth / depth.mean((1, 2, 3))[:, None, None, None]))
        correction = self.correct_depth(clip, found.estimates, found.focal, found.pairs)
        sharper = clip.depth * correction.exp()
        with torch.no_grad():
            solution = self.resolve(clip, found.estimates, found.focal, found.pairs, depth=sharper)
            encodings = self.encode(found, solution)
        seen = _placed_matches(replace(found, clip=clip), sharper, solution)
        return CameraSolution(encodings, self.corrected(clip, depth, correction), seen)

    def search(
        self,
        camera_tokens: Float[Tensor, "b t c"],
        tokens: Float[Tensor, "b t n c"],
        stem_maps: Sequence[Float[Tensor, "b t k gh gw"]],
        depth: Float[Tensor, "b t h w"],
        focal: Float[Tensor, "b"] | None = None,
    ) -> Found:
        """Matches, motions and the focal length that suits them, with the depth as it was predicted."""
        t, height, width = depth.shape[1:]
        scale = depth.mean((1, 2, 3))
        clip = self.describe(tokens, stem_maps, depth / scale[:, None, None, None])
        pairs = clip_pairs(t, depth.device)
        first = self.focal(camera_tokens) * image_diagonal(height, width, like=depth)
        known = first.new_zeros(first.shape) if focal is None else focal
        first = torch.where(known > 0, known, first)
        estimates = self.estimate(clip, first, pairs, between=follow_steps)
        refined = self.refine_focal(clip, estimates, first, pairs)
        return Found(clip, pairs, estimates, torch.where(known > 0, known, refined), scale)

    def encode(self, found: Found, solution: Solution) -> Float[Tensor, "1 b t 9"]:
        """Pose encodings of the trajectory that fits the motions of all pairs."""
        trajectory = _trajectory(solution, found.pairs, self.settings.settling)
        fields = [2 * torch.atan(0.5 * side / found.focal) for side in found.clip.size]
        encoding = [
            trajectory.translation * found.scale[:, None, None],
            matrix_to_quaternion(trajectory.rotation),
            torch.stack(fields, -1)[:, None].expand(*trajectory.translation.shape[:2], 2),
        ]
        return torch.cat(encoding, -1)[None]

    def describe(
        self,
        tokens: Float[Tensor, "b t n c"],
        stem_maps: Sequence[Float[Tensor, "b t k gh gw"]],
        depth: Float[Tensor, "b t h w"],
    ) -> Clip:
        """Matching features and queries of a clip; ``depth`` has clip mean about 1."""
        size = (depth.shape[-2], depth.shape[-1])
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        features: MatchingFeatures = self.encoder(stem_maps[-1], tokens, grid)
        principal = _principal_point(*size, like=depth)
        rows, columns = features.descriptors.shape[-2:]
        queries = query_centres(rows, columns, like=depth) - principal
        return Clip(features, size, principal, queries, query_depth(depth))

    def estimate(
        self,
        clip: Clip,
        focal: Float[Tensor, "b"],
        pairs: ClipPairs,
        *,
        between: Callable[[Motion], Motion] = lambda motion: motion,
    ) -> PairEstimates:
        """Motions of p pairs of frames of each clip (e = b p, clip-major).

        Args:
            clip: Features, queries and their depth.
            focal: Focal length in pixels.
            pairs: What is matched.
            between: What becomes of the motions (b, p, ...) of one round before the next looks where they lead.
        """
        source, target = pairs.source, pairs.target
        cells = _per_pair(focal / CELL, pairs)
        correlation = self.matcher.correlate(
            clip.features.descriptors[:, source].flatten(0, 1), clip.features.descriptors[:, target].flatten(0, 1)
        )
        context = clip.features.context[:, source].flatten(0, 1)
        distance = clip.depth[:, source].flatten(0, 1)
        principal = clip.principal
        points = _points(clip, distance, cells)
        position = (clip.queries / principal).expand(distance.shape[0], -1, -1)
        motion = Motion.none(points[:, 0])
        base = correlation.best
        rounds = []
        for index in range(self.settings.rounds):
            if index:
                motion = _flat(between(_per_clip(motion.detach(), pairs)))
                low, high = -principal - _OUTSIDE, principal + _OUTSIDE
                base = torch.minimum(torch.maximum(project(points, motion, cells), low), high) + principal
            matches, trust = self.matcher.correct(correlation, base.detach(), context, distance.log(), position)
            matches = matches - principal
            solution = solve_motion(
                points,
                matches,
                trust,
                cells,
                motion,
                iterations=self.settings.iterations,
                flow_noise=self.settings.flow_noise,
            )
            motion = solution.motion
            rounds.append(Round(matches, trust, solution))
        return PairEstimates(correlation, tuple(rounds))

    def refine_focal(
        self, clip: Clip, estimates: PairEstimates, first: Float[Tensor, "b"], pairs: ClipPairs
    ) -> Float[Tensor, "b"]:
        """Focal length in pixels that suits all motions of a clip, near the first estimate."""
        b, p = first.shape[0], pairs.source.shape[0]
        last = estimates.last
        distance = clip.depth[:, pairs.source].flatten(0, 1)
        shift = torch.zeros_like(first)
        for _ in range(self.settings.focal_steps):
            cells = _per_pair(first * shift.exp() / CELL, pairs)
            gradient, curvature = focal_step(
                clip.queries,
                distance,
                last.matches,
                last.trust,
                focal=cells,
                motion=last.solution.motion.detach(),
            )
            gradient, curvature = (part.unflatten(0, (b, p)) * pairs.inside for part in (gradient, curvature))
            shift = shift + fuse_focal(gradient, curvature, shift, self.focal_prior.exp())
        return first * shift.exp()

    def resolve(
        self,
        clip: Clip,
        estimates: PairEstimates,
        focal: Float[Tensor, "b"],
        pairs: ClipPairs,
        *,
        depth: Float[Tensor, "b t q"],
    ) -> Solution:
        """Motions from the last matches, with another depth or focal length."""
        cells = _per_pair(focal / CELL, pairs)
        points = _points(clip, depth[:, pairs.source].flatten(0, 1), cells)
        last = estimates.last
        start = last.solution.motion.detach()
        return solve_motion(
            points,
            last.matches,
            last.trust,
            cells,
            start,
            iterations=self.settings.final_iterations,
            flow_noise=self.settings.flow_noise,
        )

    def correct_depth(
        self,
        clip: Clip,
        estimates: PairEstimates,
        focal: Float[Tensor, "b"],
        pairs: ClipPairs,
        *,
        motion: Motion | None = None,
    ) -> Float[Tensor, "b t q"]:
        """Addition to the logarithm of the depth at the queries, by parallax under the motions of the pairs.

        Args:
            clip: Depth that is to be corrected, features.
            estimates: Matches of the pairs.
            focal: Focal length in pixels.
            pairs: What was matched.
            motion: Motions (e, ...) instead of the estimated ones.
        """
        b, t = clip.depth.shape[:2]
        cells = _per_pair(focal / CELL, pairs)
        points = _points(clip, clip.depth[:, pairs.source].flatten(0, 1), cells)
        last = estimates.last
        motion = last.solution.motion.detach() if motion is None else motion
        found = parallax(points, last.matches, last.trust, cells, motion)
        frames = torch.arange(t, device=focal.device)
        begins = (frames[:, None] == pairs.source[None]).to(focal.dtype) * pairs.inside
        gradient, curvature = (begins @ part.unflatten(0, (b, -1)) for part in found)
        correction: Tensor = self.refiner(
            gradient, curvature, clip.depth.log(), clip.queries / clip.principal, clip.features.context
        )
        return correction

    def corrected(
        self, clip: Clip, depth: Float[Tensor, "b t h w"], correction: Float[Tensor, "b t q"]
    ) -> Float[Tensor, "b t h w"]:
        """``depth`` times the exponential of the correction."""
        grid = (clip.features.context.shape[-2], clip.features.context.shape[-1])
        maps = depth.flatten(0, 1)
        factor = spread_queries(correction.flatten(0, 1).unflatten(-1, grid), maps).exp()
        product: Tensor = (maps * factor).unflatten(0, (depth.shape[0], depth.shape[1]))
        return product


def image_diagonal(height: int, width: int, *, like: Tensor) -> Float[Tensor, ""]:
    """Length of the diagonal in pixels."""
    sides = [torch.full((), side, device=like.device, dtype=like.dtype) for side in (height, width)]
    return (sides[0].square() + sides[1].square()).sqrt()


def _placed_matches(found: Found, depth: Float[Tensor, "b t q"], solution: Solution) -> PlacedMatches:
    """Gradients reach the points only."""
    pairs, last = found.pairs, found.estimates.last
    cells = _per_pair(found.focal / CELL, pairs)
    there = pairs.inside.to(depth.dtype).expand(found.focal.shape[0], -1).flatten()
    points = _points(found.clip, depth[:, pairs.source].flatten(0, 1), cells)
    return PlacedMatches(points, last.matches, last.trust * there[:, None, None], cells, solution.motion)


def _trajectory(solution: Solution, pairs: ClipPairs, settling: int) -> Motion:
    """Camera-from-first-camera motions from the solutions of a clip's pairs."""
    count = pairs.source.shape[0]
    motion = _per_clip(solution.motion, pairs)
    information = solution.information.unflatten(0, (-1, count))
    return settle_trajectory(fuse_trajectory(motion, information), motion, information, pairs, count=settling)


def _per_clip(motion: Motion, pairs: ClipPairs) -> Motion:
    """From (e, ...) to (b, p, ...)."""
    shape = (-1, pairs.source.shape[0])
    return Motion(motion.rotation.unflatten(0, shape), motion.translation.unflatten(0, shape))


def _flat(motion: Motion) -> Motion:
    """From (b, p, ...) to (e, ...)."""
    return Motion(motion.rotation.flatten(0, 1), motion.translation.flatten(0, 1))


def _per_pair(values: Float[Tensor, "b"], pairs: ClipPairs) -> Float[Tensor, "e"]:
    return values[:, None].expand(-1, pairs.source.shape[0]).flatten()


def _points(clip: Clip, depth: Float[Tensor, "e q"], cells: Float[Tensor, "e"]) -> Float[Tensor, "e q 3"]:
    """The queries as points of the source camera."""
    return rays(clip.queries.expand(*depth.shape, 2), cells[:, None].expand(depth.shape)) * depth[..., None]


def _principal_point(height: int, width: int, *, like: Tensor) -> Float[Tensor, "2"]:
    """Centre of the image, (x, y) in cells."""
    sides = [torch.full((), side, device=like.device, dtype=like.dtype) for side in (width, height)]
    return torch.stack(sides) / (2 * CELL)

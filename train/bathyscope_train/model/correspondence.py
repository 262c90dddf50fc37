"""Where the points of one frame are seen in another: features, correlation, and learnt corrections.

Unit of length: a *cell* of 4 px. Cell (column, row) has its centre at (column + 0.5, row + 0.5). Queries are
every second cell of the source frame, keys all cells of the target frame.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bathyscope_train.model.stem import CELL, ResidualConv

QUERY_STEP = 2
"""Cells between two queries."""

_RADIUS = 3
_WINDOW = (2 * _RADIUS + 1) ** 2
_REACH = 10.0
_OUT_OF_REACH = -20.0
_INITIAL_TEMPERATURE = 2.7
_LARGEST_FACTOR = 60.0
CONTEXT = 32
"""Channels of the features of a query."""


@dataclass(frozen=True, slots=True)
class MatchingFeatures:
    """What the matcher knows of each frame."""

    descriptors: Float[Tensor, "b t c gh gw"]
    """Unit vectors of the cells."""
    context: Float[Tensor, "b t k qh qw"]
    """Features of the queries."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """Similarities of e pairs of frames, and the best matches they give."""

    logits: Float[Tensor, "e q gh gw"]
    normaliser: Float[Tensor, "e q"]
    """Log-sum-exp of the logits, cells beyond the reach pushed down."""
    queries: Float[Tensor, "q 2"]
    best: Float[Tensor, "e q 2"]
    """Match with sub-cell precision, in cells."""
    evidence: Float[Tensor, "e q 2"]
    """Probability of the peak and of the window around it."""


class MatchingEncoder(nn.Module):
    """Descriptors and context from the stem's quarter-size map and the last tokens."""

    def __init__(self, token_width: int, stem_channels: int, width: int = 64) -> None:
        super().__init__()
        self.from_stem = nn.Conv2d(stem_channels, width, 1)
        self.from_tokens = nn.Linear(token_width, width)
        self.refine = nn.Sequential(
            nn.GroupNorm(8, width),
            ResidualConv(width),
            ResidualConv(width, dilation=2),
            nn.GroupNorm(8, width),
            ResidualConv(width),
        )
        self.descriptor = nn.Conv2d(width, width, 1)
        self.context = nn.Conv2d(width, CONTEXT, 1)

    def forward(
        self, quarter: Float[Tensor, "b t c gh gw"], tokens: Float[Tensor, "b t n k"], grid: tuple[int, int]
    ) -> MatchingFeatures:
        """Features of clips; ``tokens`` are those of a ``grid`` of patches."""
        b, t = quarter.shape[:2]
        size = (quarter.shape[-2], quarter.shape[-1])
        coarse = self.from_tokens(tokens.flatten(0, 1)).transpose(1, 2).unflatten(2, grid)
        maps = self.from_stem(quarter.flatten(0, 1))
        maps = self.refine(maps + F.interpolate(coarse, size=size, mode="bilinear", align_corners=False))
        context = F.gelu(self.context(maps[..., ::QUERY_STEP, ::QUERY_STEP]))
        descriptors = self.descriptor(maps)
        length = (descriptors.square().sum(1, keepdim=True) + 1e-7).sqrt()
        return MatchingFeatures((descriptors / length).unflatten(0, (b, t)), context.unflatten(0, (b, t)))


class Matcher(nn.Module):
    """Correlation of pairs, and the small network that corrects a match and weighs it."""

    def __init__(self, hidden: int = 96) -> None:
        super().__init__()
        self.temperature = nn.Parameter(torch.tensor(_INITIAL_TEMPERATURE))
        inputs = _WINDOW + 2 + 2 + 2 + 2 + CONTEXT + 1 + 2
        self.update = nn.Sequential(
            nn.Conv2d(inputs, hidden, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(hidden, hidden, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(hidden, 64, 3, padding=1),
            nn.GELU(),
        )
        self.correction = nn.Conv2d(64, 2, 3, padding=1)
        self.trust = nn.Conv2d(64, 2, 3, padding=1)
        for head in (self.correction, self.trust):
            nn.init.normal_(head.weight, std=0.01)
            assert head.bias is not None
            nn.init.zeros_(head.bias)

    def correlate(self, source: Float[Tensor, "e c gh gw"], target: Float[Tensor, "e c gh gw"]) -> Correlation:
        """Similarities of the queries of ``source`` with all cells of ``target``, and their peaks."""
        gh, gw = target.shape[-2:]
        picked = source[..., ::QUERY_STEP, ::QUERY_STEP].flatten(2)
        factor = self.temperature.exp().clamp_max(_LARGEST_FACTOR)
        logits = factor * (picked.transpose(1, 2) @ target.flatten(2))
        keys = cell_centres(gh, gw, like=logits)
        queries = query_centres(gh, gw, like=logits)
        far = (queries[:, None] - keys[None]).abs().amax(-1) > _REACH
        limited = logits + _OUT_OF_REACH * far.to(logits.dtype)
        normaliser = limited.logsumexp(-1)
        start = keys[limited.argmax(-1)]
        maps = logits.unflatten(2, (gh, gw))
        window = look_up(maps, start)
        share = window.softmax(-1)
        best = start + share @ _offsets(logits)
        evidence = torch.stack([window.amax(-1), window.logsumexp(-1)], -1) - normaliser[..., None]
        return Correlation(maps, normaliser, queries, best, evidence.clamp_max(0).exp())

    def correct(
        self,
        correlation: Correlation,
        base: Float[Tensor, "e q 2"],
        context: Float[Tensor, "e k qh qw"],
        log_depth: Float[Tensor, "e q"],
        position: Float[Tensor, "e q 2"],
    ) -> tuple[Float[Tensor, "e q 2"], Float[Tensor, "e q 2"]]:
        """Corrected matches, in cells, and the trust (0 to 1) in each of their coordinates.

        Args:
            correlation: Similarities of the pairs.
            base: Where to look, in cells; no gradient flows to it.
            context: Features of the queries.
            log_depth: Logarithm of their depth in units of the clip's mean.
            position: Where they are in the image, about -1 to 1.
        """
        queries, best = correlation.queries, correlation.best
        channels = torch.cat(
            [
                look_up(correlation.logits, base) / 8,
                (base - queries) / 4,
                (best - base) / 4,
                correlation.evidence,
                (best - queries) / 4,
                log_depth[..., None],
                position,
            ],
            -1,
        )
        grid = (context.shape[-2], context.shape[-1])
        hidden = self.update(torch.cat([channels.transpose(1, 2).unflatten(2, grid), context], 1))
        corrected = base + self.correction(hidden).flatten(2).transpose(1, 2)
        return corrected, self.trust(hidden).flatten(2).transpose(1, 2).sigmoid()


def look_up(logits: Float[Tensor, "e q gh gw"], base: Float[Tensor, "e q 2"]) -> Float[Tensor, "e q k"]:
    """The 7x7 similarities around ``base``, bilinear, zero outside the frame."""
    e, q, gh, gw = logits.shape
    size = torch.stack([torch.full((), gw, device=logits.device), torch.full((), gh, device=logits.device)])
    points = 2 * (base[:, :, None] + _offsets(logits)) / size.to(logits.dtype) - 1
    sampled = F.grid_sample(
        logits.reshape(e * q, 1, gh, gw), points.reshape(e * q, 1, _WINDOW, 2).detach(), align_corners=False
    )
    return sampled.reshape(e, q, _WINDOW)


def cell_centres(rows: int, columns: int, *, like: Tensor, step: int = 1) -> Float[Tensor, "n 2"]:
    """Centres (x, y) of every ``step``-th cell of a grid, in cells, row by row."""
    x = torch.arange(0, columns, step, device=like.device, dtype=like.dtype) + 0.5
    y = torch.arange(0, rows, step, device=like.device, dtype=like.dtype) + 0.5
    size = (y.shape[0], x.shape[0])  # len() would fix the size in an exported graph
    grid = torch.stack([x[None, :].expand(size), y[:, None].expand(size)], -1)
    return grid.flatten(0, 1)


def query_centres(rows: int, columns: int, *, like: Tensor) -> Float[Tensor, "q 2"]:
    """Centres of the queries of a grid of cells."""
    return cell_centres(rows, columns, like=like, step=QUERY_STEP)


def query_depth(depth: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b q"]:
    """Depth at the queries: the pixel just before each centre."""
    step = CELL * QUERY_STEP
    start = CELL // 2 - 1
    return depth[..., start::step, start::step].flatten(-2)


def _offsets(like: Tensor) -> Float[Tensor, "k 2"]:
    side = 2 * _RADIUS + 1
    return cell_centres(side, side, like=like) - (_RADIUS + 0.5)

"""How good rendered depth is on clips with ground truth: the paper's numbers and flicker, clip by clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bathyscope_train.consistency.geometry import encode, predict
from bathyscope_train.consistency.rendering import render_clip
from bathyscope_train.consistency.terms import ImageTerm
from bathyscope_train.data.windows import TruthClip
from bathyscope_train.evaluation.alignment import median_scale
from bathyscope_train.evaluation.flicker import flicker
from bathyscope_train.evaluation.intervals import finite_mean
from bathyscope_train.evaluation.metrics import depth_errors, mean_errors
from bathyscope_train.losses.valid import LEAST_OPACITY
from bathyscope_train.model.network import Network
from bathyscope_train.render import CpuRenderer, Renderer
from bathyscope_train.validation import window_index

CENTRAL = 0.8
"""Sides of the central crop, as a share of the frame's."""
Maps = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Scores:
    """Of one clip, or a mean over clips; RMSE and SqRel in the unit of the truth."""

    abs_rel: float
    """One median scale a frame, as all that follow."""
    sq_rel: float
    rmse: float
    rmse_log: float
    delta1: float
    flicker: float
    """Per cent; see :mod:`bathyscope_train.evaluation.flicker`."""
    abs_rel_clip: float
    """With one median scale for the clip."""


@dataclass(frozen=True, slots=True)
class ClipScores:
    """One clip, over the full frame and its central 80 %."""

    name: str
    full: Scores
    central: Scores


def score_network(
    network: Network, clips: Sequence[TruthClip], *, frames: int, renderer: Renderer | None = None
) -> list[ClipScores]:
    """Rendered depth of one window of each clip (stride 2 where it is long enough) against the truth.

    Where less than a share of 0.3 of the light is stopped, rendered depth is no answer; the head's stands in, as no
    pixel may be left out of a comparison.

    Args:
        network: On the CPU.
        clips: At the network's size.
        frames: Of a window.
        renderer: Splatting; the fast one for CPUs unless given.
    """
    renderer = renderer or CpuRenderer()
    scores = []
    for clip in clips:
        index = window_index(len(clip.frames), frames)
        images = clip.frames[index][None].float() / 255
        depth = rendered_depth(network, images, renderer)
        truth = clip.depth[index].numpy()
        scores.append(score_clip(clip.name, depth, truth))
    return scores


@torch.no_grad()
def rendered_depth(network: Network, images: torch.Tensor, renderer: Renderer) -> Maps:
    """Depth (t, h, w) of one clip (1, t, 3, h, w)."""
    training = network.training
    network.eval()
    inside = torch.ones(1, *images.shape[-2:], dtype=torch.bool)
    geometry = predict(network, encode(network, images, trained=False), images, inside)
    rendered = render_clip(geometry, renderer, ImageTerm(weight=0))
    network.train(training)
    depth = rendered.depth.where(rendered.opacity >= LEAST_OPACITY, geometry.depth)
    return np.asarray(depth[0].numpy(), np.float32)


def score_clip(name: str, depth: Maps, truth: Maps) -> ClipScores:
    """Scores of depth (t, h, w) against the truth, 0 where unknown."""
    height, width = truth.shape[-2:]
    top, left = round(height * (1 - CENTRAL) / 2), round(width * (1 - CENTRAL) / 2)
    inner = slice(None), slice(top, height - top), slice(left, width - left)
    return ClipScores(name, _scores(depth, truth), _scores(depth[inner], truth[inner]))


def mean_scores(clips: Sequence[Scores]) -> Scores:
    """Mean over clips, those without a value left out."""
    return Scores(*(finite_mean(np.array([asdict(each)[name] for each in clips])) for name in NAMES))


NAMES = tuple(Scores.__dataclass_fields__)


def _scores(depth: Maps, truth: Maps) -> Scores:
    known = truth > 0
    frames = [index for index in range(len(truth)) if known[index].any()]
    pairs = [(truth[index][known[index]], depth[index][known[index]]) for index in frames]
    by_frame = mean_errors([depth_errors(true, found * median_scale([true], [found])) for true, found in pairs])
    scale = median_scale([true for true, _ in pairs], [found for _, found in pairs])
    by_clip = mean_errors([depth_errors(true, found * scale) for true, found in pairs])
    everywhere = np.ones(depth.shape[1:], np.bool_)
    jerks = [flicker(a, b, c, everywhere) for a, b, c in zip(depth, depth[1:], depth[2:], strict=False)]
    return Scores(
        abs_rel=by_frame.abs_rel,
        sq_rel=by_frame.sq_rel,
        rmse=by_frame.rmse,
        rmse_log=by_frame.rmse_log,
        delta1=by_frame.delta1,
        flicker=finite_mean(np.array(jerks)),
        abs_rel_clip=by_clip.abs_rel,
    )

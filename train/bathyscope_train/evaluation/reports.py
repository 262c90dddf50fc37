"""What an evaluation says; the JSON of ``bathyscope evaluate --json`` is these models."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator

from bathyscope.result import BundleId


def _number_or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float | None, BeforeValidator(_number_or_none)]
"""A measured number; null where there was nothing to measure, because JSON has no NaN."""


class _Strict(BaseModel, frozen=True, extra="forbid"):
    """Frozen, and unknown fields are refused."""


class DepthScores(_Strict):
    """Means over frames of per-frame errors, after one scale for the clip."""

    abs_rel: Number
    sq_rel: Number
    rmse: Number
    rmse_log: Number
    delta1: Number
    delta2: Number
    delta3: Number
    scale: Number
    """median(true) / median(predicted) over the clip; null in a mean over data sets."""
    coverage: Number
    """Share of the pixels with true depth that have a prediction."""


class PoseScores(_Strict):
    """Camera motion against the truth; lengths in ``unit``."""

    unit: str
    gap: int
    """Frames between the two cameras of a pair."""
    pairs: int
    rotation_error_deg_mean: Number
    rotation_error_deg_median: Number
    true_rotation_deg_mean: Number
    """What predicting no rotation would get as its mean error."""
    true_translation_mean: Number
    direction_cosine_mean: Number
    direction_cosine_median: Number
    rpe_translation: Number
    """Root mean square over pairs, after the Sim(3) scale."""
    rpe_rotation_deg: Number
    ate_rmse: Number
    """After Sim(3); each segment of the result by itself, pooled over frames."""
    ate_standing_still: Number
    """ATE of a camera that never moves."""
    aligned_frames: int
    pose_scale_over_depth_scale: Number
    """1 where depth and camera motion of the prediction share one scale; null if their units cannot be compared."""
    snippet_ate_mean: Number = None
    """The field's ATE over snippets of 5 frames; null where a frame has no pose or the prediction has a cut."""
    snippet_rotation_deg_mean: Number = None


class FocalScores(_Strict):
    """Predicted over true focal length, median over frames; 1 is right."""

    fx_ratio: float
    fy_ratio: float


class Counts(_Strict):
    """What was measured on."""

    frames: int
    frames_with_truth: int
    """Frames with at least one evaluated pixel: those that the means are over."""
    pixels_with_truth: int
    pixels: int
    """Evaluated: with true depth, and with a prediction of every network output compared."""


class NetworkReport(_Strict):
    """One output of the network on one folder."""

    depth: DepthScores
    poses: PoseScores | None
    focal: FocalScores | None
    """Null from a model without cameras, as poses are."""
    segments: int
    """More than one: the engine saw a cut, and the depth scale may jump there. One scale is used all the same."""
    warnings: tuple[str, ...]


class FolderReport(_Strict):
    """All measurements on one folder."""

    dataset: str
    truth: Literal["dense", "sparse"]
    unit: str
    counts: Counts
    network: dict[str, NetworkReport]
    baselines: dict[str, DepthScores]


class Protocol(_Strict):
    """How the numbers came about."""

    alignment: str = "one factor for each clip: median(true) / median(predicted) over all evaluated pixels"
    averaging: str = "mean over the pixels of a frame, then mean over the frames of the clip"
    clipping: str = "none"
    pixels: str = "the same for every row: true depth inside depth_valid and mask, and predicted by every output"
    frame_gap: int


class EvaluationReport(_Strict):
    """Everything that one run of ``bathyscope evaluate`` measured."""

    bundle: BundleId
    software: str
    protocol: Protocol
    datasets: list[FolderReport]
    mean: dict[str, DepthScores]
    """Plain mean over data sets, for several; sq_rel and rmse are null where their units differ."""

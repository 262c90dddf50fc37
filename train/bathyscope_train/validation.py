"""How good a network is on held-out clips with exact truth: depth, motion, focal length, and two floors."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from bathyscope_train.data.windows import Batch, TruthClip, cut_window
from bathyscope_train.losses.camera import length
from bathyscope_train.model.network import Network, Prediction
from bathyscope_train.model.pose_encoding import decode_cameras
from bathyscope_train.model.rigid import relative_motion, rotation_logarithm
from bathyscope_train.model.unprojection import invert_rigid

PAIR_STRIDE = 3
"""Frames of a window between the two cameras of a measured motion: 6 raw frames at stride 2."""

_STILL_DEG = 0.05
_STILL_LENGTH = 1e-3


@dataclass(frozen=True, slots=True)
class Validation:
    """Means over clips (depth) and medians over pairs (motion)."""

    abs_rel: float
    """Mean |d - g| / g with one median scale a clip."""
    delta1: float
    """Share of pixels with max(d/g, g/d) < 1.25."""
    constant: float
    """AbsRel of constant depth."""
    best_map: float
    """AbsRel of one fixed map for all clips: the median of these very clips at each pixel."""
    rotation_deg: float
    """Median rotation error of pairs 6 frames apart."""
    rotation_true_deg: float
    """Median true rotation of the same pairs."""
    direction_cosine: float
    """Median cosine between true and estimated direction of translation."""
    focal_ratio: float
    """Median of estimated over true focal length."""

    def as_json(self) -> str:
        """One line."""
        return json.dumps({name: round(value, 5) for name, value in asdict(self).items()})


@dataclass(frozen=True, slots=True)
class Example:
    """One clip as evaluated, for a picture."""

    name: str
    image: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    true: Float[Tensor, "h w"]


def validate(
    network: Network, clips: Sequence[TruthClip], *, frames: int = 8, known_focal: bool = False
) -> tuple[Validation, list[Example]]:
    """Run the network on one window (stride 2 where the clip is long enough) of each clip.

    Args:
        network: What is measured.
        clips: With true depth and poses.
        frames: Length of a window.
        known_focal: Whether the network is told the focal length.
    """
    depths, motions, focals, truths, examples = [], [], [], [], []
    was_training = network.training
    network.eval()
    with torch.no_grad():
        for clip in clips:
            batch = cut_window(clip, window_index(len(clip.frames), frames))
            prediction = network(batch.images, batch.focal if known_focal else None)
            depths.append(depth_scores(prediction.maps.depth[0].numpy(), batch.depth[0].numpy()))
            motions.append(motion_scores(prediction, batch))
            focals.append(float(focal_ratio(prediction, batch)))
            truths.append(batch.depth[0].numpy())
            middle = batch.images.shape[1] // 2
            examples.append(
                Example(clip.name, batch.images[0, middle], prediction.maps.depth[0, middle], batch.depth[0, middle])
            )
    network.train(was_training)
    pairs = np.concatenate(motions)
    moving = pairs[pairs[:, 3] > _STILL_LENGTH]
    abs_rel, delta1 = np.mean(depths, 0)
    summary = Validation(
        abs_rel=float(abs_rel),
        delta1=float(delta1),
        constant=float(np.mean([depth_scores(np.ones_like(true), true)[0] for true in truths])),
        best_map=float(np.mean([depth_scores(_best_map(truths, true.shape), true)[0] for true in truths])),
        rotation_deg=float(np.median(pairs[:, 0])),
        rotation_true_deg=float(np.median(pairs[:, 1])),
        direction_cosine=float(np.median(moving[:, 2])) if len(moving) else float("nan"),
        focal_ratio=float(np.median(focals)),
    )
    return summary, examples


def window_index(length_of_clip: int, frames: int) -> list[int]:
    """Frames of the measured window: stride 2 from the start, or 1 in a short clip."""
    stride = 2 if (frames - 1) * 2 < length_of_clip else 1
    return list(range(0, min(frames * stride, length_of_clip), stride))


def depth_scores(depth: NDArray[np.float32], true: NDArray[np.float32]) -> tuple[float, float]:
    """AbsRel and delta 1 of maps (t, h, w) with one median scale; pixels without truth do not count."""
    valid = true > 0
    predicted, expected = depth[valid], true[valid]
    predicted = predicted * (np.median(expected) / np.median(predicted))
    ratio = np.maximum(predicted / expected, expected / predicted)
    return float(np.mean(np.abs(predicted - expected) / expected)), float(np.mean(ratio < 1.25))


def motion_scores(prediction: Prediction, batch: Batch) -> NDArray[np.float64]:
    """Rows (rotation error, true rotation, both in degrees; cosine of directions; true length) of pairs of frames."""
    size = (batch.depth.shape[-2], batch.depth.shape[-1])
    poses = invert_rigid(decode_cameras(prediction.pose_encoding, size).camera_from_world)
    source = torch.arange(max(batch.depth.shape[1] - PAIR_STRIDE, 0))
    rotation, translation = relative_motion(poses[0], source, source + PAIR_STRIDE)
    true_rotation, true_translation = relative_motion(batch.world_from_camera[0], source, source + PAIR_STRIDE)
    error = length(rotation_logarithm(rotation @ true_rotation.transpose(-1, -2)))
    true_length = length(true_translation)
    cosine = (translation * true_translation).sum(-1) / (length(translation) * true_length).clamp_min(1e-9)
    degrees = [torch.rad2deg(error), torch.rad2deg(length(rotation_logarithm(true_rotation)))]
    return torch.stack([*degrees, cosine, true_length], -1).double().numpy()


def focal_ratio(prediction: Prediction, batch: Batch) -> Tensor:
    """Median over frames of estimated over true focal length."""
    size = (batch.depth.shape[-2], batch.depth.shape[-1])
    return decode_cameras(prediction.pose_encoding, size).intrinsics[0, :, 0, 0].median() / batch.focal[0]


def write_grid(path: Path, examples: Sequence[Example]) -> None:
    """Write a PNG with a row for each example: image, estimated depth, true depth in one colour range.

    A frame without truth is shown in the range of its own depth.
    """
    import cv2

    rows = []
    for example in examples:
        true = example.true.numpy()
        valid = true > 0
        depth = example.depth.numpy()
        if valid.any():  # a frame of a reconstruction may hold no point
            depth = depth * (np.median(true[valid]) / np.median(depth[valid]))
        low, high = np.percentile(true[valid] if valid.any() else depth, (2, 98))
        image = np.ascontiguousarray((example.image.permute(1, 2, 0).numpy() * 255).astype(np.uint8)[..., ::-1])
        maps = [np.where(keep, _shade(each, low, high), 0) for each, keep in ((depth, True), (true, valid))]
        coloured = [cv2.applyColorMap(each.astype(np.uint8), cv2.COLORMAP_TURBO) for each in maps]
        rows.append(np.concatenate([image, *coloured], 1))
    half = (len(rows) + 1) // 2
    columns = [np.concatenate(part) for part in (rows[:half], rows[half:]) if part]
    height = columns[0].shape[0]
    columns = [np.pad(each, ((0, height - each.shape[0]), (0, 0), (0, 0))) for each in columns]
    cv2.imwrite(str(path), np.concatenate(columns, 1))


def _shade(depth: NDArray[np.float32], low: float, high: float) -> NDArray[np.float32]:
    """Near is bright; even steps of inverse depth."""
    inverse = 1 / np.clip(depth, low, high)
    return np.asarray(255 * (inverse - 1 / high) / (1 / low - 1 / high + 1e-9), np.float32)


def _best_map(truths: Sequence[NDArray[np.float32]], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The median over all frames of the clips' depths, each clip divided by its own median, at every pixel."""
    scaled = [np.where(true > 0, true / np.median(true[true > 0]), np.nan) for true in truths]
    with np.errstate(all="ignore"):
        best = np.nanmedian(np.concatenate(scaled), axis=0)
    return np.broadcast_to(np.nan_to_num(best, nan=1.0), shape).astype(np.float32)

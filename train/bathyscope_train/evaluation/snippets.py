"""The field's pose errors over snippets of five frames, as AF-SfMLearner and its family report them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64
from bathyscope.errors import GeometryError

SNIPPET_FRAMES = 5


@dataclass(frozen=True, slots=True)
class SnippetErrors:
    """One number for each start frame; the last snippets of a sequence are shorter."""

    ate: F64
    """(n,) root of the sum of squared position errors, over the number of positions; after one scale a snippet."""
    rotation_rad: F64
    """(n,) mean angle between true and predicted camera."""

    def summary(self) -> tuple[float, float, float, float]:
        """Mean and standard deviation of ``ate``, then of ``rotation_rad``."""
        return (
            float(self.ate.mean()),
            float(self.ate.std()),
            float(self.rotation_rad.mean()),
            float(self.rotation_rad.std()),
        )


def relative_poses(camera_from_world: F64) -> NDArray[np.float32]:
    """``T_i``, which maps points of camera i to camera i + 1: (n - 1, 4, 4) of poses (n, 4, 4), in float32."""
    inverse = np.linalg.pinv(camera_from_world[:-1])
    return np.asarray(camera_from_world[1:] @ inverse, np.float32)


def snippet_errors(
    true: NDArray[np.floating], predicted: NDArray[np.floating], frames: int = SNIPPET_FRAMES
) -> SnippetErrors:
    """Errors of the snippets that begin at each pair of frames but the last: the shortest spans two pairs.

    Args:
        true: Relative poses (n, 4, 4); see :func:`relative_poses`.
        predicted: Relative poses (n, 4, 4) of the same pairs, right up to a scale for each snippet.
        frames: Frames of a full snippet.

    Raises:
        GeometryError: If the numbers of poses differ or there are fewer than two.
    """
    if true.shape != predicted.shape or true.ndim != 3 or true.shape[1:] != (4, 4) or len(true) < 2:
        raise GeometryError(
            f"snippet errors need equal numbers of 4x4 poses, at least two, got {true.shape} and {predicted.shape}"
        )
    ate, angles = [], []
    for start in range(len(true) - 1):
        stop = start + frames - 1
        expected, observed = chained(true[start:stop]), chained(predicted[start:stop])
        ate.append(_position_error(expected[:, :3, 3], observed[:, :3, 3]))
        angles.append(_rotation_error(expected[:, :3, :3], observed[:, :3, :3]))
    return SnippetErrors(np.array(ate), np.array(angles))


def chained(relative: NDArray[np.floating]) -> F64:
    """Poses (m + 1, 4, 4) from the identity on, each the one before times the next of ``relative`` (m, 4, 4)."""
    poses = [np.eye(4)]
    for step in np.asarray(relative, np.float64):
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def _position_error(true: F64, predicted: F64) -> float:
    predicted = predicted + (true[0] - predicted[0])
    length = float((predicted**2).sum())
    scale = float((true * predicted).sum()) / length if length > 0 else 0.0
    return float(np.sqrt(((scale * predicted - true) ** 2).sum()) / len(true))


def _rotation_error(true: F64, predicted: F64) -> float:
    r = true @ np.linalg.inv(predicted)
    sines = np.stack([r[:, 0, 1] - r[:, 1, 0], r[:, 1, 2] - r[:, 2, 1], r[:, 0, 2] - r[:, 2, 0]])
    return float(np.arctan2(np.linalg.norm(sines, axis=0), np.trace(r, axis1=1, axis2=2) - 1).mean())

"""Random changes of a window without ground truth, the same for all its frames: crop, mirrors, time, colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from bathyscope.camera import F64, Size
from bathyscope.vision.field_of_view import FieldOfView

F32 = NDArray[np.float32]


class ClipChanges(BaseModel, frozen=True, extra="forbid"):
    """How far windows are changed; not in the paper. ``none()`` leaves them as they are."""

    crop: float = Field(default=0.8, gt=0, le=1, description="Smallest side of a random crop, as a share.")
    crop_chance: float = Field(default=0.5, ge=0, le=1)
    off_centre: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="How far a crop may lie from the middle, 1 for anywhere: it moves the principal point, which no "
        "network here predicts.",
    )
    mirror_chance: float = Field(
        default=0.5, ge=0, le=1, description="Left and right; and the same for top and bottom."
    )
    reverse_chance: float = Field(default=0.5, ge=0, le=1, description="Backwards in time.")
    gamma: tuple[float, float] = (0.8, 1.25)
    gain: tuple[float, float] = (0.85, 1.15)
    tint: float = Field(default=0.05, ge=0, lt=1, description="Largest change of one colour channel.")

    @classmethod
    def none(cls) -> ClipChanges:
        """No change at all."""
        return cls(crop=1, crop_chance=0, mirror_chance=0, reverse_chance=0, gamma=(1, 1), gain=(1, 1), tint=0)


@dataclass(frozen=True, slots=True)
class DrawnChanges:
    """What was drawn for one window."""

    share: float
    """Of the field of view's sides that are kept."""
    place: tuple[float, float]
    """Where the crop lies in the room it has, 0 to 1 down and to the right."""
    flip: tuple[bool, bool]
    """Left and right; top and bottom."""
    reverse: bool
    gamma: float
    gain: NDArray[np.float64]
    """(3,)"""


def draw_changes(changes: ClipChanges, random: np.random.Generator) -> DrawnChanges:
    """Draw the changes of one window. Always takes the same number of draws, so later ones do not depend on it."""
    chance = random.random(4)
    share, down, right = random.uniform(changes.crop, 1), random.random(), random.random()
    gamma, gain = random.uniform(*changes.gamma), random.uniform(*changes.gain)
    tint = 1 + random.uniform(-changes.tint, changes.tint, 3)
    return DrawnChanges(
        share=float(share) if chance[0] < changes.crop_chance else 1.0,
        place=(0.5 + changes.off_centre * float(down - 0.5), 0.5 + changes.off_centre * float(right - 0.5)),
        flip=(bool(chance[1] < changes.mirror_chance), bool(chance[2] < changes.mirror_chance)),
        reverse=bool(chance[3] < changes.reverse_chance),
        gamma=float(gamma),
        gain=gain * tint,
    )


def crop_view(view: FieldOfView, drawn: DrawnChanges, aspect: float | None = None) -> FieldOfView:
    """The part of a field of view that the crop shows.

    Args:
        view: At source size.
        drawn: The crop.
        aspect: Width over height that the crop must have, the largest of its kind; the field of view's unless given.
    """
    top, left, bottom, right = view.box
    height, width = bottom - top, right - left
    if aspect is not None:
        height, width = min(height, round(width / aspect)), min(width, round(height * aspect))
    height, width = max(round(height * drawn.share), 1), max(round(width * drawn.share), 1)
    top += round((bottom - top - height) * drawn.place[0])
    left += round((right - left - width) * drawn.place[1])
    mask = np.zeros_like(view.mask)
    mask[top : top + height, left : left + width] = view.mask[top : top + height, left : left + width]
    return FieldOfView(mask, view.shape) if mask.any() else view


def recolour(frames: F32, drawn: DrawnChanges) -> F32:
    """Gamma, then gain of each channel, of frames (t, 3, h, w); black stays black."""
    if drawn.gamma != 1:
        frames = np.power(frames, np.float32(drawn.gamma))
    return np.asarray(np.clip(frames * drawn.gain.astype(np.float32)[:, None, None], 0, 1), np.float32)


def mirror_frames(frames: NDArray[np.generic], drawn: DrawnChanges) -> NDArray[np.generic]:
    """Frames or masks (..., h, w) in the mirrors that were drawn."""
    if drawn.flip[0]:
        frames = frames[..., ::-1]
    return frames[..., ::-1, :] if drawn.flip[1] else frames


def mirror_intrinsics(intrinsics: F64, size: Size, drawn: DrawnChanges) -> F64:
    """Intrinsics (3, 3) of the mirrored image of this size."""
    turned = intrinsics.copy()
    for axis, (flip, length) in enumerate(zip(drawn.flip, (size[1], size[0]), strict=True)):
        if flip:
            turned[axis, 2] = length - turned[axis, 2]
    return turned


def mirror_poses(world_from_camera: F64, drawn: DrawnChanges) -> F64:
    """Poses (t, 4, 4) in the mirrored world: still rigid."""
    flip = np.diag([-1.0 if drawn.flip[0] else 1.0, -1.0 if drawn.flip[1] else 1.0, 1.0, 1.0])
    return np.asarray(flip @ world_from_camera @ flip)

"""Where every pixel of one frame of a clip is in another, and whether it can be seen there."""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope.errors import SettingsError
from bathyscope_train.data.synthetic.clip import SyntheticClip
from bathyscope_train.data.synthetic.lens import distort, undistort
from bathyscope_train.data.synthetic.swell import carried

_CLOSE = 0.02  # relative difference of depth up to which two surfaces are one


class Flow(NamedTuple):
    """Motion of the pixels of a source frame into a target frame."""

    flow: npt.NDArray[np.float32]
    """``(h, w, 2)``: to the right and down, in pixels; 0 where not valid."""
    depth: npt.NDArray[np.float32]
    """``(h, w)``: z-depth of the same points in the target camera; 0 where not valid."""
    valid: npt.NDArray[np.bool_]
    """``(h, w)``: the source pixel shows something, and it ends in front of the target camera."""
    visible: npt.NDArray[np.bool_]
    """``(h, w)``: valid, inside the target's image and field of view, and nothing stands before it there."""


def optical_flow(clip: SyntheticClip, source: int, target: int) -> Flow:
    """Exact flow: the depth of every pixel, carried by the camera, the instruments and the tissue's own motion.

    Nothing is matched: the pixel's ray is cut at its depth, the point is moved with the body that it belongs to,
    and is projected through the target's lens. A point counts as visible where the depth rendered at its place in the
    target agrees with its own within 2 % or a pixel's slope.

    Args:
        clip: A rendered clip.
        source: Frame whose pixels are followed.
        target: Frame that they are followed to.

    Raises:
        SettingsError: If the clip has no such frame.
    """
    count, height, width = clip.depth.shape
    if not (0 <= source < count and 0 <= target < count):
        raise SettingsError(f"frames {source} and {target} of a clip of {count}; frames count from 0")
    world = _followed(clip, source, target)
    pose = np.linalg.inv(clip.world_from_camera[target])
    camera = world @ pose[:3, :3].T + pose[:3, 3]
    z = camera[..., 2]
    valid = clip.valid[source] & (z > 1e-3)
    bare = camera[..., :2] / np.where(valid, z, 1.0)[..., None]
    focal, centre = np.diag(clip.intrinsics)[:2], clip.intrinsics[:2, 2]
    place = distort(bare, clip.distortion) * focal + centre
    flow = np.where(valid[..., None], place - _pixels(height, width), 0.0)
    return Flow(
        flow=flow.astype(np.float32),
        depth=np.where(valid, z, 0.0).astype(np.float32),
        valid=valid,
        visible=_seen(clip, target, place, z, valid),
    )


def _pixels(height: int, width: int) -> npt.NDArray[np.float64]:
    v, u = np.mgrid[:height, :width]
    return np.stack([u + 0.5, v + 0.5], axis=-1)


def _followed(clip: SyntheticClip, source: int, target: int) -> npt.NDArray[np.float64]:
    """World points of the source's pixels at the time of the target, ``(h, w, 3)``."""
    height, width = clip.depth.shape[1:]
    focal, centre = np.diag(clip.intrinsics)[:2], clip.intrinsics[:2, 2]
    slopes = undistort((_pixels(height, width) - centre) / focal, clip.distortion)
    depth = clip.depth[source].astype(np.float64)[..., None]
    pose = clip.world_from_camera[source]
    world = np.concatenate([slopes * depth, depth], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
    still = clip.mover[source] == 0
    if clip.swell is not None:
        world[still] = carried(clip.swell, world[still], source, target)
    for index, path in enumerate(clip.world_from_mover.swapaxes(0, 1)):
        part = clip.mover[source] == index + 1
        motion = path[target] @ np.linalg.inv(path[source])
        world[part] = world[part] @ motion[:3, :3].T + motion[:3, 3]
    return np.asarray(world, np.float64)


def _seen(
    clip: SyntheticClip,
    target: int,
    place: npt.NDArray[np.float64],
    z: npt.NDArray[np.float64],
    valid: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """Whether the target's depth at ``place`` is that of the point: within the range of the four pixels around it."""
    height, width = clip.depth.shape[1:]
    depth = clip.depth[target]
    inside = valid & (place >= 0).all(-1) & (place[..., 0] <= width) & (place[..., 1] <= height)
    column = np.clip(np.floor(place[..., 0] - 0.5).astype(int), -1, width - 1)
    row = np.clip(np.floor(place[..., 1] - 0.5).astype(int), -1, height - 1)
    padded = cv2.copyMakeBorder(depth, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    around = np.stack([padded[row + 1 + i, column + 1 + j] for i in (0, 1) for j in (0, 1)], axis=-1)
    shown = np.where(around > 0, around, np.inf).min(-1), around.max(-1)
    nearest = np.clip(np.rint(place - 0.5).astype(int), 0, (width - 1, height - 1))
    in_view = clip.valid[target][nearest[..., 1], nearest[..., 0]]
    return np.asarray(inside & in_view & (z > shown[0] * (1 - _CLOSE)) & (z < shown[1] * (1 + _CLOSE)))

"""Time within a frame: motion blur while the shutter is open, and the two fields of interlaced video.

Both move the picture along its motion: at ``s`` frames after the frame's instant, pixel u shows what is at
``u - s * motion(u)`` now. Depth and poses are those of the instant itself.
"""

import cv2
import numpy as np
import numpy.typing as npt

from bathyscope.camera import pixel_grid
from bathyscope_train.data.synthetic.lens import distort, undistort

Array = npt.NDArray[np.float32]

_MOST_PX = 24.0
_LEAST_PX = 0.25
_TAPS = 9


def advance(image: Array, motion: Array, share: float) -> Array:
    """The image ``(h, w, 3)`` at ``share`` frames later, for a motion ``(h, w, 2)`` in pixels a frame."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    shift = np.float32(share) * np.clip(motion, -_MOST_PX, _MOST_PX)
    return np.asarray(
        cv2.remap(image, u - shift[..., 0], v - shift[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        np.float32,
    )


def smear(image: Array, motion: Array, shutter: float) -> Array:
    """Mean image while the shutter is open, for ``shutter`` frames around the instant."""
    longest = shutter * float(np.percentile(np.abs(motion).max(axis=-1), 95))
    if longest < _LEAST_PX:
        return image
    taps = min(2 * int(np.ceil(0.5 * longest)) + 1, _TAPS)
    total = np.zeros_like(image)
    for share in (np.arange(taps) + 0.5) / taps - 0.5:
        total += advance(image, motion, shutter * float(share))
    return np.asarray(total / np.float32(taps), np.float32)


def interlace(image: Array, motion: Array) -> Array:
    """Even rows of this instant, odd rows of the one half a frame later."""
    woven = image.copy()
    woven[1::2] = advance(image, motion, 0.5)[1::2]
    return woven


def image_motion(
    depth: Array,
    scene_from_camera: npt.NDArray[np.float64],
    intrinsics: npt.NDArray[np.float64],
    distortion: tuple[float, float],
) -> Array:
    """Pixels that each point of a still scene moves until the next frame, ``(t, h, w, 2)``; 0 where nothing is.

    The last frame moves on as it came. A point that passes behind the camera does not move.

    Args:
        depth: ``(t, h, w)``.
        scene_from_camera: ``(t, 4, 4)``.
        intrinsics: ``(3, 3)``.
        distortion: k1 and k2 of the lens.
    """
    frames = len(depth)
    pixels = pixel_grid((depth.shape[1], depth.shape[2]))
    centre, focal = intrinsics[:2, 2], np.array([intrinsics[0, 0], intrinsics[1, 1]])
    rays = undistort((pixels - centre) / focal, distortion)
    motion = np.zeros((*depth.shape, 2), np.float32)
    for index in range(frames if frames > 1 else 0):
        other, sign = (index + 1, 1.0) if index + 1 < frames else (index - 1, -1.0)
        carry = np.linalg.inv(scene_from_camera[other]) @ scene_from_camera[index]
        points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) * depth[index][..., None]
        points = points @ carry[:3, :3].T + carry[:3, 3]
        ahead = (depth[index] > 0) & (points[..., 2] > 0.1)
        plane = points[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None]
        moved = distort(plane, distortion) * focal + centre - pixels
        motion[index] = np.where(ahead[..., None], sign * moved, 0.0)
    return motion

"""A network that knows the scene: exact depth and cameras in front of a slanted plane, told frames apart by their grey.

Each window comes back in a world and a scale of its own, as from a real network, so stitching has something to do.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import invert_pose, pixel_grid, rebase
from bathyscope.clip import Clip
from bathyscope.model_spec import SceneSpec
from bathyscope.scene import WindowMaps

PLANE_NORMAL = np.array([0.2, -0.1, 1.0])
PLANE_OFFSET = 3.0
FIELD_OF_VIEW = (0.9, 1.1)
"""Vertical and horizontal, radians, of the network's image."""
GREY = 60
SPEC = SceneSpec(pixel_centre=0.5, focal_epsilon=0.0, activation="footprint", sh_degree=0)


def grey_clip(frames: int, size: tuple[int, int] = (90, 120)) -> Clip:
    """Frame i is grey 60 + i all over: brighter than any border, and its number can be read from it."""
    images = np.broadcast_to((GREY + np.arange(frames, dtype=np.uint8))[:, None, None, None], (frames, *size, 3))
    return Clip(np.ascontiguousarray(images), np.arange(frames) / 25, "grey")


def pose(index: int) -> NDArray[np.float64]:
    """World-from-camera of frame ``index``: sideways, forward and turning."""
    angle = 0.01 * index
    moved = np.eye(4)
    moved[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    moved[:3, 3] = [0.02 * index, 0.03 * np.sin(0.3 * index), 0.01 * index]
    return moved


def focal_lengths(size: tuple[int, int]) -> tuple[float, float]:
    """fx, fy of the network's image."""
    return size[1] / 2 / np.tan(FIELD_OF_VIEW[1] / 2), size[0] / 2 / np.tan(FIELD_OF_VIEW[0] / 2)


def plane_depth(index: int, intrinsics: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Z-depth of the plane n . x = d: (d - n . c) / (n . R r) for the ray r = (x, y, 1) of each pixel."""
    pixels, camera = pixel_grid(size), pose(index)
    rays = np.stack(
        [
            (pixels[..., 0] - intrinsics[0, 2]) / intrinsics[0, 0],
            (pixels[..., 1] - intrinsics[1, 2]) / intrinsics[1, 1],
            np.ones(size),
        ],
        -1,
    )
    return (PLANE_OFFSET - PLANE_NORMAL @ camera[:3, 3]) / (rays @ camera[:3, :3].T @ PLANE_NORMAL)


class AnalyticModel:
    """Answers in the world of a window's first camera, with a scale drawn for each window."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(3)
        self.windows: list[list[int]] = []
        self.focals: list[float | None] = []

    def predict(
        self,
        images: NDArray[np.float32],
        checkpoint: Callable[[], None] = lambda: None,
        *,
        focal: float | None = None,
    ) -> WindowMaps:
        checkpoint()
        self.focals.append(focal)
        indices = [round(float(image.max()) * 255) - GREY for image in images]
        self.windows.append(indices)
        size = (images.shape[2], images.shape[3])
        fx, fy = focal_lengths(size)
        intrinsics = np.array([[fx, 0, size[1] / 2], [0, fy, size[0] / 2], [0, 0, 1]])
        scale = self.random.uniform(0.5, 2.0) if len(self.windows) > 1 else 1.0
        depth = scale * np.stack([plane_depth(index, intrinsics, size) for index in indices])
        return WindowMaps(
            depth.astype(np.float32),
            np.full(depth.shape, 2.0, np.float32),
            self._gaussians(len(indices), size),
            self._encode(indices, scale),
        )

    def _gaussians(self, frames: int, size: tuple[int, int]) -> NDArray[np.float32]:
        raw = np.zeros((frames, 12, *size), np.float32)
        raw[:, 0] = 3.0
        return raw

    def _encode(self, indices: list[int], scale: float) -> NDArray[np.float32]:
        camera_from_world = invert_pose(rebase(np.stack([pose(index) for index in indices])))
        encoding = np.zeros((len(indices), 9))
        encoding[:, :3] = scale * camera_from_world[:, :3, 3]
        half = np.arctan2(camera_from_world[:, 0, 2], camera_from_world[:, 0, 0]) / 2
        encoding[:, 4], encoding[:, 6] = np.sin(half), np.cos(half)  # a turn about y
        encoding[:, 7:] = FIELD_OF_VIEW
        return encoding.astype(np.float32)

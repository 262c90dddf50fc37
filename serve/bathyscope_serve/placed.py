"""A frame on its way from the network to the result, and the Gaussians that it brings along."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Similarity
from bathyscope.splat import PreparedScene

F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sight:
    """Where points that are followed through the video are in one frame."""

    ids: NDArray[np.int64]
    """(n,) rising; a number is never used twice."""
    places: F32
    """(n, 2) u and v in pixels of the network's image."""
    pixel: float
    """Pixels of the network's image that a pixel of the followed picture covers."""


@dataclass(frozen=True, slots=True)
class FrameScene:
    """What the Gaussians of one frame are made of, wherever it is placed: one for each pixel."""

    image: F32
    """(3, h, w)"""
    raw: F32
    """(g, h, w) channels of the network."""


@dataclass(frozen=True, slots=True)
class WindowScene:
    """Gaussians that a whole window shares, in its own world."""

    gaussians: PreparedScene
    camera_from_window: F64
    """(4, 4)"""
    scale: float = 1.0
    """From the window's unit to that of the result."""


@dataclass(frozen=True, slots=True)
class PlacedFrame:
    """One frame at the network's size."""

    index: int
    """Number of the frame in the source."""
    timestamp_s: float
    depth: F32
    """(h, w) as the frame has it by itself, later as it is rendered."""
    confidence: F32
    """(h, w)"""
    known: NDArray[np.bool_]
    """(h, w) where depth and confidence mean something."""
    world_from_camera: F64
    """(4, 4)"""
    intrinsics: F64
    """(3, 3) in pixels of the network's image."""
    key: bool = True
    """Whether it is far enough from the key frame before to be compared with it."""
    scene: FrameScene | WindowScene | None = None
    sight: Sight | None = None
    """Where the followed points are, if any are followed."""
    segment: int = 0

    def moved(self, motion: Similarity, segment: int) -> PlacedFrame:
        """The frame in another world."""
        scene = self.scene
        if isinstance(scene, WindowScene):
            scene = replace(scene, scale=scene.scale * motion.scale)
        return replace(
            self,
            depth=(self.depth * np.float32(motion.scale)).astype(np.float32),
            world_from_camera=motion.poses(self.world_from_camera),
            scene=scene,
            segment=segment,
        )

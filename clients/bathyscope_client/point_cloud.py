"""``NAME_cloud.ply``: coloured points of the clip's world, binary little endian."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import unproject_pixels
from bathyscope.result import FrameDepth
from bathyscope_client.depth_colours import ClipRange

_STEEP = 0.04
"""Relative change of depth to a neighbouring pixel above which a pixel lies on an edge, not on a surface."""
VERTEX = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])
_HEADER = """ply
format binary_little_endian 1.0
comment world of segment {segment} of {segments}; x right, y down, z forward; scale {scale}
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


class CloudWriter:
    """Takes an equal share of points from every frame of the longest segment, at sure pixels away from depth edges.

    Args:
        path: The file.
        span: What is usual in the clip; pixels less sure than ``span.sure`` are left out.
        most_points: Largest number of points in the file.
        scale: What one unit is, for the header.
    """

    def __init__(self, path: Path, span: ClipRange, most_points: int, scale: str) -> None:
        self._path, self._span, self._scale = path, span, scale
        self._share = max(1, most_points // max(1, span.frames))
        self._most = most_points
        self._count = 0
        self._random = np.random.default_rng(0)
        self._body = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 - closed by close() or abandon()

    def add(self, frame: FrameDepth, image: NDArray[np.uint8]) -> None:
        """Add some points of one frame, which has a camera."""
        if frame.segment != self._span.longest_segment:
            return
        assert frame.intrinsics is not None
        assert frame.world_from_camera is not None
        sure = True if frame.confidence is None else frame.confidence >= self._span.sure
        candidates = np.flatnonzero(frame.valid & sure & ~steep(frame.depth))
        wanted = min(self._share, len(candidates), self._most - self._count)
        picked = self._random.choice(candidates, wanted, replace=False) if wanted else candidates[:0]
        rows, columns = np.unravel_index(picked, frame.depth.shape)
        pixels = np.stack([columns, rows], -1).astype(np.float64) + 0.5
        vertices = np.empty(len(picked), VERTEX)
        vertices["position"] = unproject_pixels(
            pixels, frame.depth[rows, columns], frame.intrinsics, frame.world_from_camera
        )
        vertices["colour"] = image[rows, columns]
        self._body.write(vertices.tobytes())
        self._count += len(vertices)

    def close(self) -> None:
        """Write header and points."""
        header = _HEADER.format(
            segment=self._span.longest_segment, segments=self._span.segments, scale=self._scale, count=self._count
        )
        self._body.seek(0)
        with self._path.open("wb") as file:
            file.write(header.encode())
            shutil.copyfileobj(self._body, file, 1 << 20)
        self._body.close()

    def abandon(self) -> None:
        """Give up."""
        self._body.close()


def steep(depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Where depth jumps to a neighbour: points there hang in the air between two surfaces."""
    values = depth.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(values, kernel) - cv2.erode(values, kernel)
    return np.asarray(jump > 2 * _STEEP * np.maximum(values, 1e-12), np.bool_)

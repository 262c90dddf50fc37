"""A frame on its way through the refinement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, Size, invert_pose
from bathyscope_serve.alignment import blend_poses
from bathyscope_serve.placed import PlacedFrame
from bathyscope_serve.refine.agreement import FrameAgreement
from bathyscope_serve.refine.depth_field import DepthField

I64 = NDArray[np.int64]


@dataclass(slots=True)
class TrackedFrame:
    """A frame and what is known of it so far."""

    frame: PlacedFrame
    """As the windows place it."""
    ids: I64
    numbers: F64
    """(n, 4) ray x and y, focal length in pixels of the followed picture, log depth of the frame or NaN."""
    places: F64
    """(n, 2) pixels"""
    world_from_camera: F64
    """As refined so far."""
    field: DepthField
    settled: bool = False
    """Whether it has been adjusted once."""
    measured: bool = False
    """Whether its depth was corrected by points of its own."""
    agreement: FrameAgreement | None = None
    """Of its own depth with its points."""

    @property
    def size(self) -> Size:
        """(height, width) of its maps."""
        return self.frame.depth.shape[0], self.frame.depth.shape[1]

    @property
    def shows(self) -> bool:
        """Whether there is anything in the frame that could be followed."""
        return len(self.ids) > 0

    @property
    def camera_from_world(self) -> F64:
        return invert_pose(self.world_from_camera)

    def refined(self) -> PlacedFrame:
        depth = self.field.applied(self.frame.depth, self.frame.known)
        return replace(self.frame, depth=depth, world_from_camera=self.world_from_camera)

    def without_maps(self) -> TrackedFrame:
        """What frames to come need of it."""
        nothing = np.zeros((0, 0), np.float32)
        bare = replace(self.frame, depth=nothing, confidence=nothing, known=nothing > 0, scene=None, sight=None)
        return replace(self, frame=bare)


def track(frame: PlacedFrame, world_from_camera: F64, field: DepthField) -> TrackedFrame:
    """A frame with what its sights say about its points.

    Args:
        frame: As the windows place it.
        world_from_camera: (4, 4) in the refined world, as far as is known.
        field: The correction of its depth, as far as is known.
    """
    sight = frame.sight
    if sight is None:
        none = np.zeros(0, np.int64)
        return TrackedFrame(frame, none, np.zeros((0, 4)), np.zeros((0, 2)), world_from_camera, field)
    k, places = frame.intrinsics, sight.places.astype(np.float64)
    row, column = (np.minimum(places[:, axis].astype(int), frame.depth.shape[1 - axis] - 1) for axis in (1, 0))
    known = frame.known[row, column] & (frame.depth[row, column] > 0)
    numbers = np.stack(
        [
            (places[:, 0] - k[0, 2]) / k[0, 0],
            (places[:, 1] - k[1, 2]) / k[1, 1],
            np.full(len(places), (k[0, 0] + k[1, 1]) / 2 / sight.pixel),
            np.where(known, np.log(np.where(known, frame.depth[row, column], 1.0)), np.nan),
        ],
        1,
    )
    return TrackedFrame(frame, sight.ids, numbers, places, world_from_camera, field)


def carry(frame: PlacedFrame, key: TrackedFrame, scale: float) -> F64:
    """The camera of a frame in the refined world, as it stands to a key frame in that of the windows.

    Args:
        frame: As the windows place it.
        key: A key frame that has been adjusted.
        scale: Of the refined world over that of the windows, thereabouts.
    """
    between = invert_pose(key.frame.world_from_camera) @ frame.world_from_camera
    between[:3, 3] *= scale
    return np.asarray(key.world_from_camera @ between, np.float64)


def on_the_way(frame: TrackedFrame, before: TrackedFrame | None, after: TrackedFrame | None, scale: float) -> F64:
    """The camera of a frame by those of the key frames around it, and by how it stands to them in the windows.

    Of a frame that shows nothing the network cannot know that: it is taken to lie between them.
    """
    ends = [end for end in (before, after) if end is not None]
    if not ends:
        return frame.world_from_camera
    poses = [carry(frame.frame, end, scale) if frame.shows else end.world_from_camera for end in ends]
    if len(ends) == 1:
        return poses[0]
    first, last = (end.frame.index for end in ends)
    return blend_poses(poses[0], poses[1], (frame.frame.index - first) / (last - first))

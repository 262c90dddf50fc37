"""The bundle adjustment of a few key frames, and what its points say about frames beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, invert_pose
from bathyscope_serve.refine.adjustment import Sights, State, adjust, misses, uncertainty
from bathyscope_serve.refine.depth_field import KnownDepths
from bathyscope_serve.refine.resection import resect
from bathyscope_serve.refine.tracked_frame import TrackedFrame

I64 = NDArray[np.int64]

_LEAST_KEYS = 2  # sights of a point
_LEAST_SIGHTS = 12  # of a camera
_MISSED = 2.0  # pixels at which a sight is wrong
_DOUBTFUL = 0.3  # standard deviation of log depth
_LEAST_GOOD = 0.5
_MOST_DOUBT = 0.07  # median; beyond it the network knows better
_LEAST_PER_POINT = 2.6  # sights: below it, points are lost before they say anything


class Problem:
    """Key frames and the points that they see; once solved, it knows where frames beside them are."""

    def __init__(
        self, keys: list[TrackedFrame], free: NDArray[np.bool_], names: I64, sights: Sights, state: State
    ) -> None:
        self._keys, self._free, self._names, self._sights, self._state = keys, free, names, sights, state
        self._doubt = np.full(len(names), np.inf)

    @classmethod
    def of(cls, fixed: list[TrackedFrame], keys: list[TrackedFrame]) -> Problem | None:
        """The problem of key frames beside fixed ones, if there are enough sights of enough points."""
        views = [*fixed, *keys]
        if not keys or len(views) < _LEAST_KEYS:
            return None
        ids = np.concatenate([view.ids for view in views])
        camera = np.repeat(np.arange(len(views)), [len(view.ids) for view in views])
        numbers = np.concatenate([view.numbers for view in views])
        shifted = numbers[:, 3] + np.log([view.field.scale for view in views])[camera]
        numbers = np.concatenate([numbers[:, :3], shifted[:, None]], 1)
        used = np.isfinite(shifted)
        names, count = np.unique(ids[used], return_counts=True)
        names = names[count >= _LEAST_KEYS]
        used &= np.isin(ids, names)
        order = np.argsort(ids[used], kind="stable")
        ids, camera, numbers = ids[used][order], camera[used][order], numbers[used][order]
        free = np.array([False] * len(fixed) + [True] * len(keys))
        if not fixed:
            free[0] = False
        enough = np.bincount(camera, minlength=len(views)) >= _LEAST_SIGHTS
        if not (free & enough).any() or not enough[~free].any():
            return None
        sights = Sights(np.searchsorted(names, ids), camera, numbers)
        poses = np.stack([view.camera_from_world for view in views])
        state = State(poses[:, :3, :3].copy(), poses[:, :3, 3].copy(), np.zeros((len(names), 3)))
        return cls(views, free & enough, names, sights, replace(state, points=_first_points(sights, state)))

    def solve(self) -> None:
        """Adjust; a solution is dropped that many sights contradict, or that rests on too little parallax."""
        found = adjust(self._sights, self._state, self._free)
        good = found.misses(self._sights) < _MISSED
        if good.mean() < _LEAST_GOOD:
            return
        doubt = uncertainty(self._sights, found)
        per_point = len(self._sights.point) / len(self._names)
        if np.median(doubt) > _MOST_DOUBT or per_point < _LEAST_PER_POINT:
            return
        self._state = found
        np.minimum.at(self._doubt, self._sights.point[good], doubt[good])
        for number in np.nonzero(self._free)[0]:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = found.rotation[number], found.translation[number]
            self._keys[number].world_from_camera = invert_pose(pose)

    def resected(self, view: TrackedFrame, near: F64) -> F64:
        """The camera of a frame that is none of the key frames, by the points, from one that is near it."""
        seen, points, _ = self._met(view)
        numbers = view.numbers[seen]
        return invert_pose(resect(invert_pose(near), points, numbers[:, :2], numbers[:, 2]))

    def known(self, view: TrackedFrame) -> KnownDepths:
        """What the points say about a frame's depth."""
        seen, points, doubt = self._met(view)
        camera = view.camera_from_world
        local = points @ camera[:3, :3].T + camera[:3, 3]
        numbers = view.numbers[seen]
        good = (misses(local, numbers) < _MISSED) & (doubt < _DOUBTFUL) & np.isfinite(numbers[:, 3])
        return KnownDepths(view.places[seen][good], numbers[good, 3], np.log(local[good, 2]), doubt[good])

    def _met(self, view: TrackedFrame) -> tuple[I64, F64, F64]:
        """Which of a frame's points are known well, where they are, and their doubt."""
        place = np.searchsorted(self._names, view.ids).clip(0, max(0, len(self._names) - 1))
        met = (self._names[place] == view.ids) & np.isfinite(self._doubt[place])
        return np.nonzero(met)[0], self._state.points[place[met]], self._doubt[place[met]]


def _first_points(sights: Sights, state: State) -> F64:
    """Points (n, 3) in the middle of where the frames that see them have them."""
    depth = np.exp(sights.numbers[:, 3])
    rays = np.concatenate([sights.numbers[:, :2], np.ones((len(depth), 1))], 1) * depth[:, None]
    shifted = rays - state.translation[sights.camera]
    world = np.einsum("mji,mj->mi", state.rotation[sights.camera], shifted)
    count = np.bincount(sights.point)
    return np.stack([np.bincount(sights.point, world[:, axis]) / count for axis in range(3)], 1)

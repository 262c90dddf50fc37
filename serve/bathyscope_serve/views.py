"""Depth of each frame as the Gaussians around it show it, once they all lie in one world.

A frame is rendered from its own Gaussians, those of its neighbours in time and those of key frames further off. The set
moves on with the frame, whatever window a neighbour came from, so depth does not jump where windows meet. Networks that
fuse the Gaussians of a window are rendered from those of the frame's own window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import Size, invert_pose
from bathyscope.gaussians import Gaussians, concatenate
from bathyscope.model_spec import SceneSpec
from bathyscope.result import DepthKind
from bathyscope.scene import Cameras, frame_gaussians
from bathyscope.splat import Rendering, render
from bathyscope_serve.placed import FrameScene, PlacedFrame, WindowScene

A = TypeVar("A")
B = TypeVar("B")


class Map(Protocol):
    """``map``, or an executor's: results in order."""

    def __call__(self, function: Callable[[A], B], items: Iterable[A], /) -> Iterator[B]: ...


class Views:
    """Takes placed frames in order and gives them back with rendered depth.

    Rendered depth is the expected depth of the splatted scene. Where the scene is thinner than ``least_opacity`` it
    would be a guess, so the frame's own depth stands there, with its confidence lowered in proportion. Accumulated
    depth is left as it is: not divided by opacity, and 0 where there is nothing. ``"head"`` does not splat at all.

    Args:
        spec: The bundle's reading of raw Gaussians.
        inside: (h, w) the field of view: nothing else becomes a Gaussian.
        depth: Which depth.
        window: Frames of the network's windows. Half as many neighbours show a frame, and all but two key frames.
        least_opacity: See above.
        run: Maps the frames, maybe in threads.
    """

    def __init__(
        self,
        spec: SceneSpec,
        *,
        inside: NDArray[np.bool_],
        depth: DepthKind = "rendered",
        window: int = 8,
        least_opacity: float = 0.3,
        run: Map = map,
    ) -> None:
        self._spec, self._inside, self._kind, self._run = spec, inside, depth, run
        self._near, self._keys = max(1, window // 2), max(0, window - 2)
        self._least_opacity = least_opacity
        self._held: list[PlacedFrame] = []
        self._gaussians: dict[int, Gaussians] = {}
        self._next = 0
        """Place in ``_held`` of the first frame that is not rendered yet."""

    def add(self, frames: list[PlacedFrame]) -> list[PlacedFrame]:
        """Frames that can be rendered now that these have come, too."""
        if self._kind == "head":
            return frames
        if self._spec.activation != "footprint":
            return list(self._run(self._of_window, frames))
        ready = []
        for frame in frames:
            if self._held and self._held[-1].segment != frame.segment:
                ready += self.finish()
            self._held.append(frame)
            self._gaussians[frame.index] = self._own_gaussians(frame)
        return ready + self._render(self._ready())

    def finish(self) -> list[PlacedFrame]:
        """What is left of the segment."""
        left = self._render(len(self._held))
        self._held, self._gaussians, self._next = [], {}, 0
        return left

    def _ready(self) -> int:
        """How many of the frames at hand have those after them that they are rendered with."""
        keys = [place for place, frame in enumerate(self._held) if frame.key]
        if len(keys) <= self._keys // 2:
            return 0
        return min(len(self._held) - self._near // 2, keys[-1 - self._keys // 2])

    def _render(self, end: int) -> list[PlacedFrame]:
        if end <= self._next:
            return []
        rendered = list(self._run(self._view, range(self._next, end)))
        self._forget(end)
        return rendered

    def _forget(self, end: int) -> None:
        """Keep what the frames from ``end`` on are rendered with."""
        past, recent = self._held[: max(0, end - self._near)], self._held[max(0, end - self._near) : end]
        past = [frame for frame in past if frame.key][-self._keys - self._near :]
        self._held = [*past, *recent, *self._held[end:]]
        self._next = len(past) + len(recent)
        self._gaussians = {frame.index: self._gaussians[frame.index] for frame in self._held}

    def _view(self, place: int) -> PlacedFrame:
        """A frame as the Gaussians of the frames around it show it."""
        frame = self._held[place]
        around = concatenate([self._gaussians[self._held[other].index] for other in self._around(place)])
        camera = invert_pose(frame.world_from_camera)
        return self._shown(frame, render(around, camera, frame.intrinsics, _size(frame), colour=False))

    def _of_window(self, frame: PlacedFrame) -> PlacedFrame:
        """A frame as the Gaussians of its window show it."""
        assert isinstance(frame.scene, WindowScene)
        window = frame.scene
        picture = render(window.gaussians, window.camera_from_window, frame.intrinsics, _size(frame), colour=False)
        return self._shown(frame, picture, np.float32(window.scale))

    def _shown(self, frame: PlacedFrame, picture: Rendering, scale: np.float32 = np.float32(1)) -> PlacedFrame:
        depth, accumulated = picture.depth * scale, picture.accumulated * scale
        share = np.minimum(picture.opacity / max(self._least_opacity, 1e-6), 1).astype(np.float32)
        solid = (picture.opacity >= self._least_opacity) & (depth > 0)
        shown = accumulated if self._kind == "accumulated" else np.where(solid, depth, frame.depth)
        return replace(
            frame,
            depth=shown.astype(np.float32),
            confidence=np.where(solid, frame.confidence, share * frame.confidence).astype(np.float32),
            known=self._inside & (shown > 0),
            scene=None,
        )

    def _around(self, place: int) -> list[int]:
        """Places of the frames whose Gaussians show this one; as many keys before it as after, if there are."""
        nearest = sorted(range(len(self._held)), key=lambda other: (abs(other - place), other))
        near, others = nearest[: self._near], nearest[self._near :]
        keys = [other for other in others if self._held[other].key]
        half = self._keys // 2
        both = [other for other in keys if other < place][:half] + [other for other in keys if other > place][:half]
        rest = [other for other in [*keys, *others] if other not in both]
        return sorted({*near, *[*both, *dict.fromkeys(rest)][: self._keys]})

    def _own_gaussians(self, frame: PlacedFrame) -> Gaussians:
        assert isinstance(frame.scene, FrameScene)
        camera = Cameras(frame.world_from_camera[None], frame.intrinsics[None])
        return frame_gaussians(frame.scene.raw, frame.depth, frame.scene.image, camera, self._spec, inside=self._inside)


def _size(frame: PlacedFrame) -> Size:
    return frame.depth.shape[0], frame.depth.shape[1]

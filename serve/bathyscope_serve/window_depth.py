"""Depth of each frame of a window: the Gaussians of all frames, splatted into each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import F64, invert_pose, rebase
from bathyscope.model_spec import SceneSpec
from bathyscope.result import DepthKind
from bathyscope.scene import WindowMaps, assemble_scene, decode_cameras
from bathyscope.splat import prepare, render

F32 = NDArray[np.float32]
A = TypeVar("A")
B = TypeVar("B")


class Map(Protocol):
    """``map``, or an executor's: results in order."""

    def __call__(self, function: Callable[[A], B], items: Iterable[A], /) -> Iterator[B]: ...


@dataclass(frozen=True, slots=True)
class View:
    """One frame of a window, in the world of the window's first camera."""

    depth: F32
    """(h, w)"""
    confidence: F32
    """(h, w)"""
    world_from_camera: F64
    """(4, 4)"""
    intrinsics: F64
    """(3, 3) in pixels of the maps."""


def render_window(
    maps: WindowMaps,
    images: F32,
    spec: SceneSpec,
    *,
    inside: NDArray[np.bool_],
    depth: DepthKind = "rendered",
    least_opacity: float = 0.3,
    run: Map = map,
) -> list[View]:
    """Depth, confidence and cameras of a window's frames.

    Rendered depth is the expected depth of the splatted scene. Where the scene is thinner than ``least_opacity`` it
    would be a guess, so the frame's own depth-head value stands there, with its confidence lowered in proportion.
    Accumulated depth is left as it is: not divided by opacity, and 0 where there is nothing.

    Args:
        maps: What the network said.
        images: (t, 3, h, w) what it saw.
        spec: The bundle's reading of the raw maps.
        inside: (h, w) pixels of the field of view: nothing else becomes a Gaussian.
        depth: Which depth; ``"head"`` does not splat at all.
        least_opacity: See above.
        run: Maps the frames, maybe in threads.

    Raises:
        GeometryError: If the network's output is no scene.
    """
    if depth == "head":
        cameras = decode_cameras(maps.pose_encoding, maps.size, spec.focal_epsilon)
        poses = rebase(cameras.world_from_camera)
        return [
            View(maps.depth[t], maps.confidence[t], poses[t], cameras.intrinsics[t]) for t in range(len(maps.depth))
        ]
    valid = np.broadcast_to(inside, maps.depth.shape)
    scene = assemble_scene(maps, images, spec, valid=valid, colour=False)
    prepared = prepare(scene.gaussians)
    camera_from_world = invert_pose(scene.cameras.world_from_camera)

    def view(t: int) -> View:
        picture = render(prepared, camera_from_world[t], scene.cameras.intrinsics[t], maps.size, colour=False)
        share = np.minimum(picture.opacity / max(least_opacity, 1e-6), 1).astype(np.float32)
        solid = (picture.opacity >= least_opacity) & (picture.depth > 0)
        expected = np.where(solid, picture.depth, maps.depth[t])
        return View(
            depth=(picture.accumulated if depth == "accumulated" else expected).astype(np.float32),
            confidence=np.where(solid, maps.confidence[t], share * maps.confidence[t]).astype(np.float32),
            world_from_camera=scene.cameras.world_from_camera[t],
            intrinsics=scene.cameras.intrinsics[t],
        )

    return list(run(view, range(len(maps.depth))))

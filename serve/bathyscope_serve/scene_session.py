"""A clip through a scene network: windows, one world each, splatted into every frame and brought together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bathyscope.clip import FrameSequence
from bathyscope.engines import DepthOptions, WindowModel
from bathyscope.errors import SettingsError
from bathyscope.model_spec import InputSpec, SceneSpec
from bathyscope.result import DepthKind, FrameDepth, ResultMeta
from bathyscope.scene import Cameras, Scene, assemble_scene, with_focal
from bathyscope.vision.field_of_view import FieldOfView, find_field_of_view
from bathyscope.vision.grid import Grid
from bathyscope_serve.frames import FrameSource, SequenceSource
from bathyscope_serve.session import DepthSession, Job, SmallFrame
from bathyscope_serve.stitch import SmallDepth, Stitcher
from bathyscope_serve.window_depth import Map, render_window
from bathyscope_serve.windows import Window, cut_windows


class SceneSession(DepthSession):
    """A run of a scene network.

    Args:
        job: What to work on.
        model: The network.
        scene: How its outputs become a scene.
        renderers: Maps frames to rendered frames, maybe in threads.

    Raises:
        SettingsError: If depth is asked for that the network cannot give.
    """

    def __init__(self, job: Job, model: WindowModel, scene: SceneSpec, renderers: Map) -> None:
        self._depth_kind = _depth_kind(job, scene)
        super().__init__(job, ResultMeta(depth=self._depth_kind))
        self._model, self._scene, self._renderers = model, scene, renderers

    def _estimates(self, source: FrameSource, field_of_view: FieldOfView) -> Iterator[FrameDepth]:
        grid = Grid.fit(field_of_view, self._job.input)
        stitcher = Stitcher(self._job.input.overlap, self._job.settings.stitch)
        known = self._job.options.known_intrinsics
        try:
            for small in self._stitched(source, grid, stitcher):
                with self._timed("upsample"):
                    frame = _at_source_size(small, grid)
                yield frame if known is None else replace(frame, intrinsics=known)
        finally:
            self._warnings.extend(stitcher.warnings)

    def _stitched(self, source: FrameSource, grid: Grid, stitcher: Stitcher) -> Iterator[SmallDepth]:
        """Frames of the result at the network's size, as they become final."""
        wanted = self._job.input
        frames = self._frames(source, grid.to_model, grid.inside)
        for window in cut_windows(frames, wanted.window, wanted.overlap):
            depth = self._depth(window, grid)
            with self._timed("stitch"):
                final = list(stitcher.add(depth, window.shared))
            yield from final
        yield from stitcher.finish()

    def _depth(self, window: Window[SmallFrame], grid: Grid) -> list[SmallDepth]:
        images = np.stack([frame.image for frame in window.items])
        focal = known_focal(self._job.options, grid)
        with self._timed("network"):
            maps = self._model.predict(images, self._checkpoint, focal=focal)
        if focal is not None:
            maps = with_focal(maps, focal, self._scene.focal_epsilon)
        with self._timed("splat"):
            views = render_window(
                maps,
                images,
                self._scene,
                inside=grid.inside,
                depth=self._depth_kind,
                least_opacity=self._job.settings.least_opacity,
                run=self._renderers,
            )
        self._checkpoint()
        return [
            SmallDepth(
                index=frame.index,
                timestamp_s=frame.timestamp_s,
                depth=view.depth,
                confidence=view.confidence,
                known=grid.inside & (view.depth > 0),
                world_from_camera=view.world_from_camera,
                intrinsics=view.intrinsics,
                single=single,
            )
            for frame, view, single in zip(window.items, views, maps.depth, strict=True)
        ]


def scene_of_frames(
    frames: FrameSequence, model: WindowModel, spec: SceneSpec, wanted: InputSpec, options: DepthOptions
) -> Scene:
    """Cameras, with intrinsics at the size of the frames, and Gaussians of a few frames that are seen all at once.

    Raises:
        SettingsError: If the network has no Gaussians.
        GeometryError: If its output is no scene.
    """
    if not spec.gaussians:
        raise SettingsError("this network has no Gaussians, and so no scene")
    field_of_view = find_field_of_view(SequenceSource(frames).survey().brightest)
    grid = Grid.fit(field_of_view, wanted)
    images = np.stack([grid.to_model(frames.image(index)) for index in range(len(frames))])
    focal, known = known_focal(options, grid), options.known_intrinsics
    maps = model.predict(images, focal=focal)
    if focal is not None:
        maps = with_focal(maps, focal, spec.focal_epsilon)
    scene = assemble_scene(maps, images, spec, valid=np.broadcast_to(grid.inside, maps.depth.shape))
    intrinsics = grid.intrinsics_to_source(scene.cameras.intrinsics)
    if known is not None:
        intrinsics = np.tile(known, (len(frames), 1, 1))
    return Scene(Cameras(scene.cameras.world_from_camera, intrinsics), scene.gaussians)


def known_focal(options: DepthOptions, grid: Grid) -> float | None:
    """Focal length in pixels of the network, where the caller knows the camera; it has one for both axes."""
    if options.known_intrinsics is None:
        return None
    small = grid.intrinsics_to_model(options.known_intrinsics)
    return float(np.sqrt(small[0, 0] * small[1, 1]))


def _depth_kind(job: Job, scene: SceneSpec) -> DepthKind:
    """Which depth to give: without Gaussians there is only the head's."""
    wanted = job.options.depth
    if scene.gaussians:
        return wanted
    if wanted == "accumulated":
        raise SettingsError(f"{job.bundle.name} has no Gaussians to accumulate; ask for 'head' depth")
    return "head"


def _at_source_size(small: SmallDepth, grid: Grid) -> FrameDepth:
    depth, valid = grid.to_source(small.depth, small.known)
    confidence, _ = grid.to_source(small.confidence, small.known)
    return FrameDepth(
        index=small.index,
        timestamp_s=small.timestamp_s,
        depth=depth,
        confidence=confidence,
        valid=valid,
        world_from_camera=small.world_from_camera,
        intrinsics=grid.intrinsics_to_source(small.intrinsics),
        segment=small.segment,
    )

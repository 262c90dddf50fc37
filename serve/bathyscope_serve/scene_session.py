"""A clip through a scene network: windows, one world each, splatted into every frame and brought together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bathyscope.camera import invert_pose, rebase
from bathyscope.clip import FrameSequence
from bathyscope.engines import DepthOptions, WindowModel
from bathyscope.errors import SettingsError
from bathyscope.model_spec import InputSpec, SceneSpec
from bathyscope.result import DepthKind, FrameDepth, ResultMeta
from bathyscope.scene import Cameras, Scene, WindowMaps, assemble_scene, decode_cameras, with_focal
from bathyscope.splat import prepare
from bathyscope.vision.field_of_view import FieldOfView, find_field_of_view
from bathyscope.vision.grid import Grid
from bathyscope_serve.blocks import Block, cut_blocks
from bathyscope_serve.frames import FrameSource, SequenceSource
from bathyscope_serve.pace import paced
from bathyscope_serve.placed import FrameScene, PlacedFrame, Sight, WindowScene
from bathyscope_serve.refine.refiner import Refiner
from bathyscope_serve.refine.tracks import PointTracker
from bathyscope_serve.session import DepthSession, Job, SmallFrame
from bathyscope_serve.stitch import Stitcher
from bathyscope_serve.views import Map, Views

F32 = NDArray[np.float32]


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
        fused = self._depth_kind != "head" and scene.activation != "footprint"  # cannot be moved frame by frame
        self._follows = job.settings.tracks.points > 0 and not fused

    def _estimates(self, source: FrameSource, field_of_view: FieldOfView) -> Iterator[FrameDepth]:
        grid = Grid.fit(field_of_view, self._job.input)
        stitcher = Stitcher(self._job.settings.stitch)
        try:
            placed = self._refined(self._placed(source, grid, stitcher))
            for small in self._rendered(placed, grid):
                yield self._result(small, grid)
        finally:
            self._warnings.extend(stitcher.warnings)

    def _refined(self, placed: Iterable[list[PlacedFrame]]) -> Iterator[list[PlacedFrame]]:
        """The frames with cameras and depth that agree with the points that were followed."""
        if not self._follows:
            yield from placed
            return
        refiner = Refiner(self._job.settings.refine)
        for frames in placed:
            with self._timed("refine"):
                ready = refiner.add(frames)
            yield ready
        with self._timed("refine"):
            ready = refiner.finish()
        self._meaning = self._meaning.model_copy(update={"agreement": refiner.agreement})
        yield ready

    def _rendered(self, placed: Iterable[list[PlacedFrame]], grid: Grid) -> Iterator[PlacedFrame]:
        """The frames with the depth that was asked for."""
        views = Views(
            self._scene,
            inside=grid.inside,
            depth=self._depth_kind,
            window=self._job.input.window,
            least_opacity=self._job.settings.least_opacity,
            run=self._renderers,
        )
        for frames in placed:
            with self._timed("splat"):
                ready = views.add(frames)
            self._checkpoint()
            yield from ready
        with self._timed("splat"):
            ready = views.finish()
        yield from ready

    def _result(self, small: PlacedFrame, grid: Grid) -> FrameDepth:
        known = self._job.options.known_intrinsics
        with self._timed("upsample"):
            frame = _at_source_size(small, grid)
        return frame if known is None else replace(frame, intrinsics=known)

    def _placed(self, source: FrameSource, grid: Grid, stitcher: Stitcher) -> Iterator[list[PlacedFrame]]:
        """Frames in the world of their segment, as their places become final; the last list is of all that is left."""
        wanted = self._job.input
        tracker = PointTracker(grid, self._job.settings.tracks)

        def watch(image: NDArray[np.uint8], cut: bool) -> Sight | None:
            if cut:
                tracker.forget()
            return tracker.sight(image) if self._follows else None

        frames = self._frames(source, grid.to_model, grid.inside, watch)
        keyed = paced(frames, self._job.settings.pace, grid.inside)
        for block in cut_blocks(keyed, wanted.window, wanted.overlap):
            if block.shared == 0:
                stitcher.cut(block.items[0].index)
            self._place(block, grid, stitcher)
            yield stitcher.take(block.items[block.kept].index if block.kept < len(block.items) else None)
        yield stitcher.take()

    def _place(self, block: Block[SmallFrame], grid: Grid, stitcher: Stitcher) -> None:
        """Give the block's windows to the stitcher; if they do not fit together, windows of neighbours instead."""
        wanted, windows = self._job.input, iter(block.windows)
        if len(block.windows) > 1:
            woven = [self._seen(block, places, grid) for places in windows]
            with self._timed("stitch"):
                fits = stitcher.weave(woven)
            if fits:
                return
            windows = block.in_order(wanted.window, wanted.overlap)
        for places in windows:
            seen = self._seen(block, places, grid)
            with self._timed("stitch"):
                stitcher.add(seen)

    def _seen(self, block: Block[SmallFrame], places: tuple[int, ...], grid: Grid) -> list[PlacedFrame]:
        """What the network makes of one window of a block, in the world of its first camera."""
        window = [block.items[place] for place in places]
        images = np.stack([frame.image for frame in window])
        focal = known_focal(self._job.options, grid)
        with self._timed("network"):
            maps = self._model.predict(images, self._checkpoint, focal=focal)
        if focal is not None:
            maps = with_focal(maps, focal, self._scene.focal_epsilon)
        self._checkpoint()
        cameras = decode_cameras(maps.pose_encoding, maps.size, self._scene.focal_epsilon)
        poses = rebase(cameras.world_from_camera)
        keys = set(block.windows[0])
        return [
            PlacedFrame(
                index=frame.index,
                timestamp_s=frame.timestamp_s,
                depth=maps.depth[k],
                confidence=maps.confidence[k],
                known=grid.inside,
                world_from_camera=poses[k],
                intrinsics=cameras.intrinsics[k],
                key=places[k] in keys,
                scene=scene,
                sight=frame.sight,
            )
            for k, (frame, scene) in enumerate(zip(window, self._scenes(maps, images, grid), strict=True))
        ]

    def _scenes(self, maps: WindowMaps, images: F32, grid: Grid) -> Sequence[FrameScene | WindowScene | None]:
        """What each frame of a window is to be rendered from."""
        if self._depth_kind == "head" or maps.gaussians is None:
            return [None] * len(images)
        if self._scene.activation == "footprint":
            return [FrameScene(image, raw) for image, raw in zip(images, maps.gaussians, strict=True)]
        with self._timed("splat"):
            valid = np.broadcast_to(grid.inside, maps.depth.shape)
            scene = assemble_scene(maps, images, self._scene, valid=valid, colour=False)
            gaussians = prepare(scene.gaussians)
        return [WindowScene(gaussians, pose) for pose in invert_pose(scene.cameras.world_from_camera)]


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


def _at_source_size(small: PlacedFrame, grid: Grid) -> FrameDepth:
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

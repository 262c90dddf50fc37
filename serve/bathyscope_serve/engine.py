"""The depth engine: a video in, finished frames out, with memory bounded by the window."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import cast

import numpy as np

from bathyscope.bundle import Bundle
from bathyscope.clip import Clip, FrameSequence
from bathyscope.engines import DepthOptions, ModelInMemory, VideoModel, WindowModel
from bathyscope.errors import SettingsError
from bathyscope.model_spec import InputSpec, ModelSpec
from bathyscope.result import ClipDepth
from bathyscope.scene import Scene
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.runtime import OnnxModel, OnnxVideoModel
from bathyscope_serve.scene_session import SceneSession, scene_of_frames
from bathyscope_serve.session import DepthSession, Job, Source
from bathyscope_serve.video_session import VideoSession

_WARM_UP_PATCHES = 4


class DepthEngine:
    """A loaded bundle; safe to use from several threads, one run each.

    Args:
        bundle: The model, on disk or in memory.
        settings: How it is run.
        model: What to run instead of the bundle's own scene network.

    Raises:
        BundleError: If ONNX Runtime cannot load the bundle's graphs.
        SettingsError: If the settings change the windows of a network that was trained to its own.
    """

    def __init__(
        self,
        bundle: Bundle | ModelInMemory,
        settings: EngineSettings | None = None,
        *,
        model: WindowModel | None = None,
    ) -> None:
        self.bundle = bundle
        self.settings = settings or EngineSettings()
        self.input = _input(bundle.manifest, self.settings)
        self.model: WindowModel | VideoModel = model or _load(bundle, self.settings)
        self.renderers = ThreadPoolExecutor(self.settings.render_threads, thread_name_prefix="splat")

    def warm_up(self) -> None:
        """Run a short made-up clip through everything, compiling the splatter and the adjustment on the way.

        A video network is only run on two small frames: it compiles nothing, and a window of its own size may take
        minutes.
        """
        if self.bundle.manifest.kind == "video":
            side = _WARM_UP_PATCHES * self.input.patch
            cast(VideoModel, self.model).values(np.full((2, 3, side, side), 0.5, np.float32))
            return
        noise = np.random.default_rng(0).integers(0, 200, (64, 80, 3)).astype(np.uint8)
        self.depth_of(
            Clip(np.stack([noise, noise]), np.array([0.0, 0.04]), "warm-up")
        )  # a still: points are found again

    def run(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> DepthSession:
        """Begin with a video, a zip or folder of images, an open file, or frames that are read as they are needed.

        Nothing is read before the session is iterated.

        Raises:
            SettingsError: If the options ask for what the network does not have.
        """
        job = Job(source, options or DepthOptions(), name, self.bundle.id, self.settings, self.input)
        spec = self.bundle.manifest
        if spec.scene is not None:
            return SceneSession(job, cast(WindowModel, self.model), spec.scene, self.renderers.map)
        return VideoSession(job, cast(VideoModel, self.model), spec)

    def scene(self, frames: FrameSequence, options: DepthOptions | None = None) -> Scene:
        """Cameras and Gaussians of a few frames in one world, seen all at once; see :class:`bathyscope.engines.Engine`.

        Raises:
            SettingsError: If the network has no Gaussians.
        """
        spec = self.bundle.manifest
        if spec.scene is None:
            raise SettingsError(f"{spec.name} is a video network: it has no scene")
        return scene_of_frames(frames, cast(WindowModel, self.model), spec.scene, self.input, options or DepthOptions())

    def depth_of(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> ClipDepth:
        """The whole result in memory: for short clips.

        Raises:
            ClipError: If the source cannot be used.
        """
        session = self.run(source, options, name=name)
        return ClipDepth.from_frames(list(session), session.meta())


def _load(bundle: Bundle | ModelInMemory, settings: EngineSettings) -> WindowModel | VideoModel:
    if not isinstance(bundle, Bundle):
        return bundle.model
    return OnnxModel(bundle, settings) if bundle.manifest.kind == "scene" else OnnxVideoModel(bundle, settings)


def _input(spec: ModelSpec, settings: EngineSettings) -> InputSpec:
    """The network's input with what the settings say otherwise."""
    wanted = {"window": settings.window, "overlap": settings.overlap, "pixels": settings.pixels}
    changed = {name: value for name, value in wanted.items() if value is not None}
    if changed and spec.kind == "video":
        raise SettingsError(f"{spec.name} is a video network: {', '.join(changed)} cannot be changed")
    return InputSpec.model_validate(spec.input.model_dump() | changed)

"""The depth engine: a video in, finished frames out, with memory bounded by the window."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from bathyscope.bundle import Bundle
from bathyscope.clip import Clip
from bathyscope.engines import DepthOptions, ModelInMemory, WindowModel
from bathyscope.model_spec import InputSpec
from bathyscope.result import ClipDepth
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.runtime import OnnxModel
from bathyscope_serve.scene_session import SceneSession
from bathyscope_serve.session import DepthSession, Job, Source


class DepthEngine:
    """A loaded bundle; safe to use from several threads, one run each.

    Args:
        bundle: The model, on disk or in memory.
        settings: How it is run.
        model: What to run instead of the bundle's own.

    Raises:
        BundleError: If ONNX Runtime cannot load the bundle's graphs.
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
        self.model = model or (OnnxModel(bundle, self.settings) if isinstance(bundle, Bundle) else bundle.model)
        self.input = _input(bundle.manifest.input, self.settings)
        self.renderers = ThreadPoolExecutor(self.settings.render_threads, thread_name_prefix="splat")

    def warm_up(self) -> None:
        """Run a short made-up clip through everything, compiling the splatter on the way."""
        noise = np.random.default_rng(0).integers(0, 255, (2, 64, 80, 3)).astype(np.uint8)
        self.depth_of(Clip(noise, np.array([0.0, 0.04]), "warm-up"))

    def run(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> DepthSession:
        """Begin with a video, a zip or folder of images, an open file, or frames that are read as they are needed.

        Nothing is read before the session is iterated.

        Raises:
            SettingsError: If the options ask for what the network does not have.
        """
        job = Job(source, options or DepthOptions(), name, self.bundle.id, self.settings, self.input)
        scene = self.bundle.manifest.scene
        assert scene is not None
        return SceneSession(job, self.model, scene, self.renderers.map)

    def depth_of(self, source: Source, options: DepthOptions | None = None, *, name: str | None = None) -> ClipDepth:
        """The whole result in memory: for short clips.

        Raises:
            ClipError: If the source cannot be used.
        """
        session = self.run(source, options, name=name)
        return ClipDepth.from_frames(list(session), session.meta())


def _input(wanted: InputSpec, settings: EngineSettings) -> InputSpec:
    """The bundle's input with what the settings say otherwise."""
    changed = {"window": settings.window, "overlap": settings.overlap, "pixels": settings.pixels}
    merged = wanted.model_dump() | {name: value for name, value in changed.items() if value is not None}
    return InputSpec.model_validate(merged)

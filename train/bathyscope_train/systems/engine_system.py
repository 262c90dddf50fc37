"""A bundle as a system, run by the engine that serves it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from bathyscope.bundle import Bundle
from bathyscope.camera import F64
from bathyscope.clip import FrameSequence
from bathyscope.engines import DepthOptions, SceneEngine, engine_factory
from bathyscope.errors import ClipError
from bathyscope.model_spec import ModelSpec
from bathyscope.scene import Scene
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import FrameEstimate, SystemInfo, SystemOptions

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EngineSystem:
    """An engine with a model in it."""

    engine: SceneEngine
    info: SystemInfo
    options: SystemOptions

    @classmethod
    def from_bundle(cls, bundle: Bundle, options: SystemOptions, *, label: str | None = None) -> EngineSystem:
        """Load a bundle into the installed engine.

        Raises:
            SettingsError: If no engine is installed, or an option does not apply.
            BundleError: If the engine cannot load the bundle.
        """
        manifest = bundle.manifest
        name = label or f"{manifest.name} {manifest.version}"
        refuse_options(name, options, takes=("depth",))
        return cls(engine_factory()(bundle), describe(manifest, name, bundle.digest, options), options)

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`.

        Raises:
            ClipError: If the engine gives back fewer frames than went in.
        """
        known = _four_numbers(intrinsics) if self.info.cameras else None
        run = self.engine.run(frames, DepthOptions(depth=self.options.depth, intrinsics=known), name=frames.name)
        count = 0
        with closing(run):
            for frame in run:
                yield FrameEstimate(
                    index=frame.index,
                    values=np.asarray(frame.depth, np.float32),
                    valid=frame.valid,
                    confidence=None if frame.confidence is None else np.asarray(frame.confidence, np.float32),
                    world_from_camera=frame.world_from_camera,
                    intrinsics=frame.intrinsics,
                    segment=frame.segment,
                )
                count += 1
            warnings = run.meta().warnings
        for warning in warnings:
            _log.warning("%s, %s: %s", self.info.name, frames.name, warning)
        if count != len(frames):
            raise ClipError(f"{frames.name}: {len(frames)} frames went in, {count} came back: {'; '.join(warnings)}")

    def scene(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Scene:
        """See :class:`~bathyscope_train.systems.system.SceneSystem`."""
        return self.engine.scene(frames, DepthOptions(intrinsics=_four_numbers(intrinsics)))


def _four_numbers(intrinsics: F64 | None) -> str | None:
    """As the engine's options take them."""
    if intrinsics is None:
        return None
    return ",".join(repr(float(intrinsics[place])) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))


def describe(spec: ModelSpec, name: str, digest: str, options: SystemOptions) -> SystemInfo:
    """What a network that the engine runs is, as results of the engine hold its values."""
    video = spec.video
    rendered = spec.scene is not None and spec.scene.gaussians
    return SystemInfo(
        name=name,
        quantity="depth" if video is None else video.quantity,
        scale="relative" if video is None else video.scale,
        unit="mm" if video is not None and video.scale == "metric" else None,
        confidence="confidence" in spec.outputs,
        gaussians="gaussians" in spec.outputs,
        cameras="cameras" in spec.outputs,
        weights_sha256=digest,
        licence=spec.licence,
        details={"depth": options.depth if rendered else "head", **spec.input.model_dump()},
    )

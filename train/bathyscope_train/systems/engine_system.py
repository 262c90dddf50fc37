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
from bathyscope.engines import DepthOptions, Engine, engine_factory
from bathyscope.errors import ClipError
from bathyscope_train.systems.options import refuse_options
from bathyscope_train.systems.system import FrameEstimate, SystemInfo, SystemOptions

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EngineSystem:
    """An engine with a model in it."""

    engine: Engine
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
        info = SystemInfo(
            name=name,
            quantity="depth",
            scale="relative",
            confidence=True,
            cameras=True,
            weights_sha256=bundle.digest,
            licence=manifest.licence,
            details={"depth": options.depth, **manifest.input.model_dump()},
        )
        return cls(engine_factory()(bundle), info, options)

    def estimate(self, frames: FrameSequence, intrinsics: F64 | None = None) -> Iterator[FrameEstimate]:
        """See :class:`~bathyscope_train.systems.system.System`.

        Raises:
            ClipError: If the engine gives back fewer frames than went in.
        """
        run = self.engine.run(frames, DepthOptions(depth=self.options.depth), name=frames.name)
        count = 0
        with closing(run):
            for frame in run:
                yield FrameEstimate(
                    index=frame.index,
                    values=np.asarray(frame.depth, np.float32),
                    valid=frame.valid,
                    confidence=np.asarray(frame.confidence, np.float32),
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

"""What turns clips into depth, as the service and the command see it.

An engine is found through an entry point of the group ``bathyscope.engines``, so whoever calls it imports none of the
packages that implement it. A call of :meth:`Engine.run` gives a :class:`DepthRun`: finished frames, one by one, in
video order, and after the last of them what they mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PositiveInt, field_validator

from bathyscope.bundle import Bundle
from bathyscope.clip import FrameSequence
from bathyscope.errors import SettingsError
from bathyscope.model_spec import ModelSpec
from bathyscope.result import BundleId, DepthKind, FrameDepth, ResultMeta
from bathyscope.scene import Scene, WindowMaps

ENGINE_GROUP = "bathyscope.engines"
F32 = NDArray[np.float32]


def keep_going() -> None:
    """The default of ``checkpoint``: nothing stops the run."""


class DepthOptions(BaseModel, frozen=True, extra="forbid"):
    """What may be asked for with each clip."""

    stride: PositiveInt = 1
    """Use every n-th frame of the source."""
    depth: DepthKind = "rendered"
    """Depth rendered from the scene of Gaussians (expected, or accumulated), or the depth head's own. A network without
    Gaussians has only the latter, and the result says so."""
    max_frames: PositiveInt | None = None
    """Stop after this many frames of the result."""
    intrinsics: str | None = None
    """The camera's ``fx,fy,cx,cy`` in pixels of the source, where they are known: used instead of an estimate."""

    @field_validator("intrinsics")
    @classmethod
    def _four_numbers(cls, value: str | None) -> str | None:
        if value is None:
            return None
        try:
            fx, fy, cx, cy = (float(part) for part in value.split(","))
        except ValueError:
            raise ValueError(f"intrinsics are four numbers fx,fy,cx,cy in pixels, got {value!r}") from None
        if not (0 < fx < math.inf and 0 < fy < math.inf and math.isfinite(cx) and math.isfinite(cy)):
            raise ValueError(f"focal lengths must be positive and all four numbers finite, got {value!r}")
        return value

    @property
    def known_intrinsics(self) -> NDArray[np.float64] | None:
        """``intrinsics`` as a matrix (3, 3)."""
        if self.intrinsics is None:
            return None
        fx, fy, cx, cy = (float(part) for part in self.intrinsics.split(","))
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


class WindowModel(Protocol):
    """A scene network that sees a window of frames at once."""

    def predict(
        self, images: F32, checkpoint: Callable[[], None] = keep_going, *, focal: float | None = None
    ) -> WindowMaps:
        """Maps and pose encodings of frames (t, 3, h, w) in [0, 1]; safe to call from several threads.

        Args:
            images: h and w multiples of the network's patch.
            checkpoint: Called between the parts of the work; an exception from it ends the run.
            focal: Focal length in pixels where it is known; a network that solves for motion makes use of it.
        """
        ...


class VideoModel(Protocol):
    """A video network, which sees a window of frames at once."""

    def values(self, images: F32, checkpoint: Callable[[], None] = keep_going) -> F32:
        """Values (t, h, w), finite and never negative, of frames (t, 3, h', w') of RGB; see :class:`WindowModel`."""
        ...


@dataclass(frozen=True, slots=True)
class ModelInMemory:
    """A scene network that runs in this process, with what a bundle's manifest would say of it."""

    manifest: ModelSpec
    digest: str
    """SHA-256 of its weights."""
    model: WindowModel

    @property
    def id(self) -> BundleId:
        """Name, version and digest, as results carry them."""
        return BundleId(name=self.manifest.name, version=self.manifest.version, digest=self.digest)


class DepthRun(Protocol):
    """One clip on its way through an engine; iterate over it once."""

    @property
    def frame_count(self) -> int | None:
        """Frames that the result will have, as far as the source says; known once iteration has begun."""
        ...

    def __iter__(self) -> Iterator[FrameDepth]:
        """Finished frames in video order; memory does not grow with their number.

        Raises:
            ClipError: If the source cannot be used. A source that breaks off later ends the iteration instead, and
                ``meta()`` says so.
        """
        ...

    def meta(self) -> ResultMeta:
        """What the frames mean: known after the last one."""
        ...

    def close(self) -> None:
        """Stop the work at its next checkpoint; safe from another thread, and to call twice."""
        ...


class Engine(Protocol):
    """A loaded model."""

    @property
    def bundle(self) -> Bundle | ModelInMemory:
        """The model in use."""
        ...

    def warm_up(self) -> None:
        """Run once on a made-up clip, so that the first real one is not slow."""
        ...

    def run(self, source: Path | FrameSequence, options: DepthOptions = ..., *, name: str | None = None) -> DepthRun:
        """Begin with a video file, a zip or folder of images (what it is follows from its content), or with frames.

        Args:
            source: File or folder, or frames that are read as they are needed.
            options: What is asked for.
            name: What messages and ``ResultMeta.name`` call the clip; the file's stem unless given.
        """
        ...


class SceneEngine(Engine, Protocol):
    """An engine that hands out the scene itself too."""

    def scene(self, frames: FrameSequence, options: DepthOptions = ...) -> Scene:
        """Cameras (intrinsics at the size of the frames) and Gaussians of a few frames in one world, seen all at once.

        Memory grows with the number of frames. The world is the first frame's camera.

        Raises:
            SettingsError: If the network has no Gaussians.
        """
        ...


class EngineFactory(Protocol):
    """What an entry point of the group ``bathyscope.engines`` names."""

    def __call__(self, bundle: Bundle | ModelInMemory, /) -> SceneEngine:
        """Load a bundle, or take a network that is loaded already, with the engine's default settings."""
        ...


def engine_factory(name: str = "onnx") -> EngineFactory:
    """The installed engine of this name.

    Raises:
        SettingsError: If none is installed, or it cannot be imported; names the extra to install.
    """
    found = entry_points(group=ENGINE_GROUP, name=name)
    if not found:
        raise SettingsError(f"no engine {name!r} is installed; install it with: pip install 'bathyscope[serve]'")
    try:
        return cast(EngineFactory, next(iter(found)).load())
    except ImportError as error:
        raise SettingsError(
            f"engine {name!r} cannot be imported ({error}); install it with: pip install 'bathyscope[serve]'"
        ) from error

"""Two ways to a clip's npz: through a service, or with an engine in this process."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Protocol

from bathyscope.bundle import Bundle, shipped_bundle
from bathyscope.engines import DepthOptions, Engine, engine_factory
from bathyscope.result_files import NpzWriter, Precision
from bathyscope_client.client import DepthClient

OnProgress = Callable[[str, int, int | None], None]
"""Called with what is being done, how much of it is done, and how much there is in all, if known."""


class Runner(Protocol):
    """Makes results."""

    @property
    def model(self) -> str:
        """Digest of the model, by which a finished result is told from one of another model."""
        ...

    def run(self, source: Path, out: Path, options: DepthOptions, precision: Precision, progress: OnProgress) -> None:
        """Write the result of a clip as npz.

        Raises:
            BathyscopeError: If there is none.
        """
        ...


class ServiceRunner:
    """Through a service."""

    def __init__(self, client: DepthClient) -> None:
        self._client = client
        self.model = client.bundle().digest

    def run(self, source: Path, out: Path, options: DepthOptions, precision: Precision, progress: OnProgress) -> None:
        """Send the clip and fetch its result."""

        def sent(done: int, total: int | None) -> None:
            whole = total is not None and done >= total
            progress("estimating" if whole else "sending", 0 if whole else done, None if whole else total)

        self._client.download(
            source,
            out,
            options=options,
            precision=precision,
            on_sent=sent,
            on_received=lambda done, total: progress("receiving", done, total),
        )


class EngineRunner:
    """With an engine in this process."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.model = engine.bundle.digest

    @classmethod
    def load(cls, bundle: Path | None) -> EngineRunner:
        """The installed engine with a bundle, or with the shipped one.

        Raises:
            SettingsError: If no engine is installed.
            BundleError: If the bundle cannot be used.
        """
        factory = engine_factory()
        return cls(factory(Bundle.open(bundle or shipped_bundle())))

    def run(self, source: Path, out: Path, options: DepthOptions, precision: Precision, progress: OnProgress) -> None:
        """Estimate the clip here."""
        with closing(self._engine.run(source, options, name=source.stem)) as run, NpzWriter(out, precision) as writer:
            progress("estimating", 0, None)
            for number, frame in enumerate(run, 1):
                writer.append(frame)
                progress("estimating", number, run.frame_count)
            writer.close(run.meta())

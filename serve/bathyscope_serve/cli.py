"""``bathyscope serve``: the depth service on a socket."""

from __future__ import annotations

import logging
import socket
import sys
from pathlib import Path
from typing import Annotated

import structlog
import typer

from bathyscope.bundle import Bundle, shipped_bundle
from bathyscope.engines import Engine
from bathyscope.errors import BathyscopeError, SettingsError
from bathyscope_serve.engine_settings import EngineSettings
from bathyscope_serve.settings import ServiceSettings

app = typer.Typer(add_completion=False)
_WRONG_USAGE = 2


@app.command()
def serve(  # noqa: PLR0917 - typer: one parameter an option
    bundle: Annotated[Path | None, typer.Option(help="Model bundle: folder or .zip. Default: the shipped one.")] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0 takes a free one.")] = None,
    workers: Annotated[int | None, typer.Option(help="Clips estimated at the same time.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of one estimate. Default: all cores.")] = None,
    queue: Annotated[int | None, typer.Option(help="Clips that may wait; further ones get 503.")] = None,
    clips_per_client: Annotated[int | None, typer.Option(help="Clips in flight from one address; else 429.")] = None,
    max_upload_mb: Annotated[float | None, typer.Option(help="Largest body in MiB.")] = None,
    receive_timeout_s: Annotated[float | None, typer.Option(help="Time for a body to arrive.")] = None,
    work_timeout_s: Annotated[float | None, typer.Option(help="Longest estimate of one clip.")] = None,
    temp: Annotated[Path | None, typer.Option(help="Folder for temporary files.")] = None,
) -> None:
    """Run the depth service.

    Every option is also read from the environment, as BATHYSCOPE_HOST, BATHYSCOPE_MAX_UPLOAD_MB and so on.
    """
    options = {name: value for name, value in locals().items() if value is not None}
    try:
        settings = ServiceSettings.read(**options)
        engine = load_engine(settings)
        listening = bind(settings.host, settings.port)
    except BathyscopeError as error:
        typer.echo(f"bathyscope serve: {error}", err=True)
        raise typer.Exit(_WRONG_USAGE) from error
    configure_log()
    run(engine, settings, listening)


def load_engine(settings: ServiceSettings) -> Engine:
    """The engine with the bundle that the settings name.

    Raises:
        BundleError: If the bundle is missing, damaged or cannot be run.
    """
    from bathyscope_serve.engine import DepthEngine

    return DepthEngine(Bundle.open(settings.bundle or shipped_bundle()), EngineSettings(threads=settings.threads))


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        SettingsError: If the address is not one of this machine, or the port is taken.
    """
    try:
        return socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=256
        )
    except OSError as error:
        raise SettingsError(f"cannot listen on {host} port {port}: {error.strerror or error}") from error


def run(engine: Engine, settings: ServiceSettings, listening: socket.socket) -> None:
    """Serve until a signal ends it."""
    import uvicorn

    from bathyscope_serve.app import create_app
    from bathyscope_serve.body_limits import protocol_with_deadline

    config = uvicorn.Config(
        create_app(engine, settings),
        http=protocol_with_deadline(settings.header_timeout_s),
        ws="none",
        lifespan="on",
        access_log=False,
        log_config=None,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=int(settings.drain_timeout_s),
    )
    host, port = listening.getsockname()[:2]
    structlog.get_logger("bathyscope.serve").info("listening", url=f"http://{host}:{port}")
    uvicorn.Server(config).run(sockets=[listening])


def configure_log() -> None:
    """One JSON object a line on stderr; uvicorn's own messages go the same way from warnings on."""
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="%(levelname)s %(name)s %(message)s")
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.dict_tracebacks,
            structlog.processors.JSONRenderer(default=str),
        ],
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )

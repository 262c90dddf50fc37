"""``bathyscope demo``: the whole path on this machine, with the commands that a user would type."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import typer

from bathyscope.errors import ServiceError

app = typer.Typer(add_completion=False)
COMMAND = (sys.executable, "-m", "bathyscope")
_PAUSE_S = 0.1


@app.command()
def demo(
    clip: Annotated[Path | None, typer.Argument(exists=True, help="A video; the shipped one unless given.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where the outputs go.")] = Path("demo"),
    startup_s: Annotated[float, typer.Option(min=1.0, help="How long the service may take to start.")] = 180.0,
) -> None:
    """Start the service, send it a clip, stop it, and say where the outputs are."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "service.log"
    with as_file(files("bathyscope_client") / "assets" / "demo.mp4") as shipped:
        source = clip or shipped
        typer.echo("starting: bathyscope serve --port 0")
        with running_service(log, startup_s) as url:
            typer.echo(f"sending:  bathyscope depth {source} --url {url} --out {out}")
            sent = subprocess.run([*COMMAND, "depth", str(source), "--url", url, "--out", str(out)], check=False)
    if sent.returncode:
        typer.echo(f"the clip failed; the service's log is {log}", err=True)
        raise typer.Exit(sent.returncode)
    typer.echo(f"done; outputs in {out.resolve()}:")
    for path in sorted(out.glob(f"{source.stem}*")):
        typer.echo(f"  {path.name}")


@contextmanager
def running_service(log: Path, startup_s: float, command: tuple[str, ...] = COMMAND) -> Iterator[str]:
    """A service of this installation on a free port of this machine; stopped when the block ends.

    Args:
        log: File that takes what the service prints.
        startup_s: How long it may take until it is ready.
        command: The program whose sub-command ``serve`` is the service.

    Yields:
        Its address.

    Raises:
        ServiceError: If it ends, or is not ready in time; quotes the end of the log.
    """
    with log.open("wb") as stream:
        service = subprocess.Popen(
            [*command, "serve", "--host", "127.0.0.1", "--port", "0"], stdout=stream, stderr=stream
        )
    try:
        yield _wait_until_ready(service, log, time.monotonic() + startup_s)
    finally:
        _stop(service)


def _wait_until_ready(service: subprocess.Popen[bytes], log: Path, deadline: float) -> str:
    import httpx

    while time.monotonic() < deadline:
        code = service.poll()
        if code is not None:
            raise ServiceError(f"the service ended with code {code} before it was ready: {_last_line(log)}")
        url = _address(log)
        if url is not None:
            try:
                if httpx.get(f"{url}/readyz", timeout=5.0, trust_env=False).is_success:
                    return url
            except httpx.TransportError:
                pass  # It listens but does not answer yet.
        time.sleep(_PAUSE_S)
    raise ServiceError(f"the service was not ready in time; see {log}: {_last_line(log)}")


def _address(log: Path) -> str | None:
    """The address in the log's line ``{"event": "listening", "url": ...}``, once it is there."""
    for line in log.read_text(errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict) and entry.get("event") == "listening":
            return str(entry["url"])
    return None


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"


def _stop(service: subprocess.Popen[bytes], patience_s: float = 20.0) -> None:
    service.terminate()
    try:
        service.wait(patience_s)
    except subprocess.TimeoutExpired:
        service.kill()
        service.wait()

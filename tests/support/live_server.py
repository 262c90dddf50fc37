"""The real HTTP server on a free port, in a thread."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import structlog
import uvicorn
from fastapi import FastAPI

from bathyscope_serve.body_limits import protocol_with_deadline
from bathyscope_serve.cli import bind


@contextmanager
def live_server(app: FastAPI, header_timeout_s: float = 10.0) -> Iterator[tuple[str, int]]:
    """Serve ``app``, ready to take clips; yields host and port."""
    listening = bind("127.0.0.1", 0)
    config = uvicorn.Config(app, http=protocol_with_deadline(header_timeout_s), ws="none", log_config=None)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        with structlog.testing.capture_logs():
            while not (server.started and app.state.service.state != "starting"):
                time.sleep(0.005)
                assert thread.is_alive(), "the server ended before it was ready"
            host, port = listening.getsockname()[:2]
            yield host, port
    finally:
        server.should_exit = True
        thread.join(20)
        listening.close()

"""What every request gets: an id, headers for safety, one line in the log, and an answer even when the code fails."""

from __future__ import annotations

import asyncio
import re
import time
import uuid

import structlog
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bathyscope_serve.body_limits import ClientStalled
from bathyscope_serve.problems import ProblemError, as_problem, problem_response

_ID = re.compile(rb"[A-Za-z0-9._-]{1,64}")
_SAFETY = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-store"),
    (
        b"content-security-policy",
        b"default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'",
    ),
)
STOPPING = ProblemError(
    503, "stopping", "the service is being stopped and did not finish this in time", headers={"Retry-After": "30"}
)
_log = structlog.get_logger("bathyscope.serve")


class RequestContext:
    """Outermost ASGI middleware.

    The id is the caller's ``X-Request-ID`` where it is a plain word of at most 64 characters, and a new one otherwise.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        answer = _Answer(send, _request_id(scope))
        scope["bathyscope.request_id"] = answer.request_id
        scope["bathyscope.log"] = notes = dict[str, object]()
        began = time.monotonic()
        try:
            await self._app(scope, receive, answer.send)
        except asyncio.CancelledError:
            notes["problem"] = STOPPING.code
            if answer.status is None:
                await problem_response(STOPPING, answer.request_id)(scope, receive, answer.send)
            raise
        except ClientStalled:
            notes["problem"] = "answer-broken-off"
        except Exception as error:
            notes["problem"] = as_problem(error).code
            if answer.status is None:
                await problem_response(as_problem(error), answer.request_id)(scope, receive, answer.send)
            else:
                notes["problem"] = "answer-broken-off"
            if as_problem(error).status == 500:
                _log.error("request_failed", request_id=answer.request_id, exc_info=error)
        finally:
            _log.info(
                "request",
                method=scope["method"],
                path=scope["path"],
                status=answer.status,
                duration_s=round(time.monotonic() - began, 4),
                bytes_out=answer.bytes_out,
                request_id=answer.request_id,
                client=(scope.get("client") or ("unknown",))[0],
                **notes,
            )


class _Answer:
    """Sends an answer on with the common headers, and remembers what the log wants to know."""

    def __init__(self, send: Send, request_id: str) -> None:
        self._send = send
        self.request_id = request_id
        self.status: int | None = None
        self.bytes_out = 0

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            common = (*_SAFETY, (b"x-request-id", self.request_id.encode()))
            message = {**message, "headers": [*message.get("headers", ()), *common]}
        self.bytes_out += len(message.get("body", b""))
        await self._send(message)


def _request_id(scope: Scope) -> str:
    for name, value in scope["headers"]:
        if name == b"x-request-id" and _ID.fullmatch(value):
            return str(value.decode())
    return uuid.uuid4().hex

"""Limits that hold while a request arrives and its answer leaves: bytes and time, around every route and parser."""

from __future__ import annotations

import asyncio
import time
import uuid

import h11
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from bathyscope_serve.problems import ProblemError, problem_response

_LINGER_S = 2.0


class ClientStalled(Exception):  # noqa: N818 - an event, not a mistake
    """The client does not read its answer."""


class BodyLimits:
    """ASGI middleware that refuses bodies that are too large or too slow, and gives up on clients that do not read.

    The declared length is checked at once; the counted one and the absolute deadline hold for chunked bodies too. The
    refusal is a :class:`~bathyscope_serve.problems.ProblemError` out of ``receive``, so memory stays that of one chunk.
    """

    def __init__(self, app: ASGIApp, *, max_bytes: int, timeout_s: float, send_timeout_s: float) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._timeout_s = timeout_s
        self._send_timeout_s = send_timeout_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        body = Body(scope, receive, self._max_bytes, self._timeout_s)
        scope["bathyscope.body"] = body
        await self._app(scope, body.next, _lingering(body, _within(self._send_timeout_s, send)))


class Body:
    """The body of one request: what has arrived of it, and how long that took."""

    def __init__(self, scope: Scope, receive: Receive, max_bytes: int, timeout_s: float) -> None:
        headers = dict(scope["headers"])
        declared = headers.get(b"content-length", b"0")
        self._declared = int(declared) if declared.isdigit() else 0
        self.expected = self._declared > 0 or b"transfer-encoding" in headers
        """Whether the request has a body at all."""
        self._receive = receive
        self._max_bytes = max_bytes
        self._timeout_s = timeout_s
        self._began = time.monotonic()
        self.received = 0
        self.complete = False
        self.received_after_s = 0.0

    async def next(self) -> Message:
        """The next message, within what is left of the time.

        Raises:
            ProblemError: 413 over the limit, by declaration or by count; 408 after the time.
        """
        if self.complete:
            return await self._receive()
        if self._declared > self._max_bytes:
            raise self._too_large()
        try:
            async with asyncio.timeout(max(0.0, self._began + self._timeout_s - time.monotonic())):
                message = await self._receive()
        except TimeoutError:
            raise ProblemError(
                408,
                "body-too-slow",
                f"the body did not arrive within {self._timeout_s:g} s ({self.received} bytes did); send it faster",
            ) from None
        self.received += len(message.get("body", b""))
        self.complete = not message.get("more_body", False)
        if self.received > self._max_bytes:
            raise self._too_large()
        self.received_after_s = time.monotonic() - self._began
        return message

    def _too_large(self) -> ProblemError:
        return ProblemError(
            413,
            "body-too-large",
            f"the body has more than {self._max_bytes} bytes, the most this service takes; "
            "send a shorter or smaller clip",
        )

    async def discard(self) -> None:
        """Read on for a moment, so that a client that is still sending gets to read the answer."""
        try:
            async with asyncio.timeout(_LINGER_S):
                while not self.complete:
                    message = await self._receive()
                    self.complete = not message.get("more_body", False)
        except TimeoutError:
            return


def _within(timeout_s: float, send: Send) -> Send:
    """Break the answer off when the client takes no part of it for so long."""

    async def send_in_time(message: Message) -> None:
        try:
            async with asyncio.timeout(timeout_s):
                await send(message)
        except TimeoutError as error:
            raise ClientStalled(f"the client took no part of its answer for {timeout_s:g} s") from error

    return send_in_time


def _lingering(body: Body, send: Send) -> Send:
    """Answers that come before the whole body end the connection, after a moment for the client to stop sending.

    Otherwise the server would read on, without any limit, to keep the connection for a next request.
    """
    early = False

    async def send_on(message: Message) -> None:
        nonlocal early
        if message["type"] == "http.response.start" and body.expected and not body.complete:
            early = True
            message = {**message, "headers": [*message.get("headers", ()), (b"connection", b"close")]}
        last = message["type"] == "http.response.body" and not message.get("more_body", False)
        if last and early:
            await send({**message, "more_body": True})
            await body.discard()
            message = {"type": "http.response.body", "body": b""}
        await send(message)

    return send_on


class DeadlineProtocol(H11Protocol):
    """uvicorn's HTTP protocol, closing connections whose request head takes too long to arrive.

    uvicorn by itself waits for a head without end; an ASGI app cannot see it, because it is called afterwards. Nor does
    it see heads that are no HTTP: these are answered with a problem like everything else.
    """

    header_timeout_s = 10.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock of the first head."""
        super().connection_made(transport)
        self._head_deadline: asyncio.TimerHandle | None = None
        self._expect_head()

    def data_received(self, data: bytes) -> None:
        """Start the clock again at the first byte of a further request."""
        if self._head_deadline is None and self._idle():
            self._expect_head()
        super().data_received(data)
        if not self._idle():
            self._forget_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock."""
        self._forget_head()
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP request, and close."""
        request_id = uuid.uuid4().hex
        answer = problem_response(ProblemError(400, "not-http", "this is no HTTP/1.1 request"), request_id)
        headers = [*answer.raw_headers, (b"x-request-id", request_id.encode()), (b"connection", b"close")]
        events = (
            h11.Response(status_code=400, headers=headers, reason=b"Bad Request"),
            h11.Data(data=bytes(answer.body)),
            h11.EndOfMessage(),
        )
        for event in events:
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def _idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _expect_head(self) -> None:
        self._head_deadline = self.loop.call_later(self.header_timeout_s, self._give_up)

    def _forget_head(self) -> None:
        if self._head_deadline is not None:
            self._head_deadline.cancel()
            self._head_deadline = None

    def _give_up(self) -> None:
        self._head_deadline = None
        if self._idle() and not self.transport.is_closing():
            self.transport.close()


def protocol_with_deadline(header_timeout_s: float) -> type[DeadlineProtocol]:
    """The protocol class with its time limit, as :class:`uvicorn.Config` takes it."""
    return type("DeadlineProtocol", (DeadlineProtocol,), {"header_timeout_s": header_timeout_s})

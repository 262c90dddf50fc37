"""``POST /depth``: a clip in, its result out."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.types import Receive, Scope, Send

from bathyscope.engines import DepthOptions
from bathyscope.result_files import Precision
from bathyscope_serve.body_limits import Body
from bathyscope_serve.estimate import Order, Outcome
from bathyscope_serve.negotiation import MEDIA_TYPES, Form, choose_form
from bathyscope_serve.problems import MEDIA_TYPE, Problem
from bathyscope_serve.service import DepthService
from bathyscope_serve.summary import ClipSummary
from bathyscope_serve.upload import FIELD, RAW_TYPES, ClientGone, plain_name, receive_clip

router = APIRouter()
_CLIENT_LEFT = 499
_FAILURES = {
    400: "The multipart body cannot be parsed, or holds no file in the field `clip`.",
    406: "None of the offered forms is accepted.",
    408: "The body did not arrive in time.",
    413: "The body is larger than the service takes.",
    415: "The content type carries no clip.",
    422: "The clip cannot be used, or an option is out of range.",
    429: "Too many clips from one client are in flight.",
    500: "The service failed.",
    503: "The model is not ready, or the queue is full.",
    507: "No room left for temporary files.",
}
_BINARY = {"schema": {"type": "string", "format": "binary"}}
RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The result, in the form that `Accept` asks for; npz unless told.",
        "content": {
            MEDIA_TYPES["npz"]: _BINARY,
            MEDIA_TYPES["zip"]: _BINARY,
            MEDIA_TYPES["json"]: {"schema": {"$ref": "#/components/schemas/ClipSummary"}},
        },
    },
    **{
        status: {"description": text, "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}}
        for status, text in _FAILURES.items()
    },
}
_FORM = {
    "type": "object",
    "required": [FIELD],
    "additionalProperties": False,
    "properties": {FIELD: {"type": "string", "format": "binary", "description": "A video, or a zip of images."}},
}
_REQUEST_BODY = {
    "required": True,
    "content": {"multipart/form-data": {"schema": _FORM}}
    | dict.fromkeys(("video/mp4", "video/webm", "video/x-matroska", "video/x-msvideo", *RAW_TYPES), _BINARY),
}
SCHEMAS = (Problem, ClipSummary)
"""Models that the responses above refer to."""


class DepthQuery(DepthOptions):
    """Options of ``POST /depth``."""

    dtype: Precision = "float32"
    """Type of the depth and confidence maps in an npz."""
    name: str | None = None
    """What to call the clip in messages and in the result; a multipart file has a name of its own."""


@router.post(
    "/depth",
    responses=RESPONSES,
    response_class=Response,
    openapi_extra={"requestBody": _REQUEST_BODY},
    summary="Depth and camera poses of a clip",
)
async def estimate_depth(request: Request, query: Annotated[DepthQuery, Query()]) -> Response:
    """Estimate depth, confidence, camera poses and intrinsics for every frame of a clip.

    The clip is the raw body or the multipart field `clip`: a video (mp4, mov, mkv, webm, avi) or a zip of images.
    """
    service: DepthService = request.app.state.service
    form = choose_form(request.headers.get("accept"))
    client = request.client.host if request.client else "unknown"
    with ExitStack() as held:
        with service.admit(client):
            folder = held.enter_context(service.folder())
            try:
                source = folder / "clip"
                name = await receive_clip(request, source) or plain_name(query.name) or "clip"
                body: Body = request.scope["bathyscope.body"]
                options = DepthOptions(**query.model_dump(include=set(DepthOptions.model_fields)))
                order = Order(source, folder, name, options, form, query.dtype, body.received_after_s)
                outcome = await service.run(order, _client_left(request))
            except ClientGone:
                return Response(status_code=_CLIENT_LEFT)
        _note(request.scope, body, outcome)
        return _answer(outcome, name, form, held.pop_all())


async def _client_left(request: Request) -> None:
    """Ends when the client closes its connection."""
    while (await request.receive())["type"] != "http.disconnect":
        await asyncio.sleep(0)


def _note(scope: Scope, body: Body, outcome: Outcome) -> None:
    scope["bathyscope.log"].update(
        bytes_in=body.received,
        frames=outcome.frames,
        complete=outcome.meta.complete,
        timings_s=outcome.meta.timings_s,
    )


def _answer(outcome: Outcome, name: str, form: Form, held: ExitStack) -> Response:
    headers = {"Server-Timing": server_timing(outcome.meta.timings_s)}
    if outcome.path is None:
        held.close()
        assert outcome.summary is not None
        return JSONResponse(outcome.summary.model_dump(mode="json"), headers=headers)
    return _ResultFile(outcome.path, held, media_type=MEDIA_TYPES[form], filename=f"{name}.{form}", headers=headers)


class _ResultFile(FileResponse):
    """Streams a result from disk; its temporary folder goes when the last byte is out, or the client has left."""

    chunk_size = 1 << 20

    def __init__(self, path: Any, held: ExitStack, **options: Any) -> None:
        super().__init__(path, **options)
        self._held = held

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._held:
            await super().__call__(scope, receive, send)


def server_timing(timings_s: Mapping[str, float]) -> str:
    """A ``Server-Timing`` header, in milliseconds."""
    return ", ".join(f"{name.replace(' ', '_')};dur={1000 * seconds:.1f}" for name, seconds in timings_s.items())

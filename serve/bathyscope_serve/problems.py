"""Failures as problem details (RFC 9457): one shape for every answer that is not a success."""

from __future__ import annotations

import errno
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from bathyscope.errors import BathyscopeError, ClipError, SettingsError

MEDIA_TYPE = "application/problem+json"
_TYPE = "urn:bathyscope:problem:"
_UNPROCESSABLE = 422


class Problem(BaseModel):
    """What went wrong with a request."""

    type: str = Field(description="Stable name of the kind of failure, for programs.")
    title: str
    status: int
    detail: str = Field(description="What was found, what was needed, and what to do.")
    request_id: str = Field(description="The request's name in the service's log.")


class ProblemError(Exception):
    """Ends a request with a problem."""

    def __init__(self, status: int, code: str, detail: str, *, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.headers = headers or {}


def problem_response(error: ProblemError, request_id: str) -> Response:
    """The answer to a request that failed."""
    problem = Problem(
        type=_TYPE + error.code,
        title=_title(error.status),
        status=error.status,
        detail=error.detail,
        request_id=request_id,
    )
    return JSONResponse(problem.model_dump(), error.status, headers=error.headers, media_type=MEDIA_TYPE)


def as_problem(error: BaseException) -> ProblemError:
    """The problem that an exception amounts to; what nobody foresaw is a 500 without inner details."""
    match error:
        case ProblemError():
            return error
        case ClipError() | SettingsError():
            code = "clip-unusable" if isinstance(error, ClipError) else "option-does-not-apply"
            return ProblemError(_UNPROCESSABLE, code, str(error))
        case HTTPException():
            return ProblemError(error.status_code, _code(error.status_code), _sentence(error), headers=_headers(error))
        case RequestValidationError():
            return ProblemError(_UNPROCESSABLE, "option-out-of-range", _describe(error))
        case OSError(errno=errno.ENOSPC | errno.EDQUOT):
            return ProblemError(507, "storage-full", "the service has no room left for this clip; try again later")
        case _:
            return ProblemError(
                500, "internal-error", "the service failed; its log has the reason under the request id"
            )


def install(app: FastAPI) -> None:
    """Answer every failure of the app's routes with a problem."""
    for kind in (ProblemError, HTTPException, RequestValidationError, BathyscopeError, OSError):
        app.add_exception_handler(kind, _handle)


async def _handle(request: Request, error: Exception) -> Response:
    found = as_problem(error)
    if found.status == 500:
        raise error
    notes: dict[str, object] = request.scope.setdefault("bathyscope.log", {})
    notes["problem"] = found.code
    return problem_response(found, request.scope["bathyscope.request_id"])


def _code(status: int) -> str:
    return HTTPStatus(status).phrase.lower().replace(" ", "-")


def _title(status: int) -> str:
    return HTTPStatus(status).phrase


def _sentence(error: HTTPException) -> str:
    if error.status_code == 404:
        return "there is nothing at this path; /docs lists what there is"
    if error.status_code == 405:
        return f"this path takes {(error.headers or {}).get('Allow', 'other methods')} only"
    return str(error.detail)


def _headers(error: HTTPException) -> dict[str, str]:
    return dict(error.headers or {})


def _describe(error: RequestValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())

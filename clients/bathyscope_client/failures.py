"""Everything that can go wrong with a service, as one kind of error."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import httpx

from bathyscope.errors import ServiceError

_SHOWN = 200


@contextmanager
def as_service_error(url: str) -> Iterator[None]:
    """Turn whatever the HTTP library raises into a :class:`~bathyscope.errors.ServiceError`."""
    try:
        yield
    except httpx.TimeoutException as error:
        raise ServiceError(f"{url}: no answer in time ({type(error).__name__}); give it a longer timeout") from error
    except httpx.ConnectError as error:
        raise ServiceError(f"{url}: cannot be reached ({error}); is `bathyscope serve` running there?") from error
    except (httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
        raise ServiceError(f"{url}: not the URL of a service ({error}); an example is http://localhost:8000") from error
    except httpx.HTTPError as error:
        raise ServiceError(f"{url}: the connection broke ({error or type(error).__name__})") from error


def refusal(answer: httpx.Response) -> ServiceError:
    """The error that an answer with a failure status stands for; its body must have been read."""
    request_id = answer.headers.get("x-request-id")
    detail = _detail(answer)
    return ServiceError(
        f"{answer.request.url.host}: {answer.status_code} {answer.reason_phrase}: {detail}",
        status=answer.status_code,
        request_id=request_id,
    )


def _detail(answer: httpx.Response) -> str:
    if answer.headers.get("content-type", "").startswith("application/problem+json"):
        try:
            return str(json.loads(answer.content)["detail"])
        except (ValueError, KeyError, TypeError):
            pass
    return answer.text[:_SHOWN].strip() or "no reason given"

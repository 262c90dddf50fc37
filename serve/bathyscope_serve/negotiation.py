"""Which form of the result a client accepts (RFC 9110, section 12.5.1)."""

from __future__ import annotations

from typing import Literal

from bathyscope_serve.problems import ProblemError

Form = Literal["npz", "zip", "json"]
MEDIA_TYPES: dict[Form, str] = {"npz": "application/x-npz", "zip": "application/zip", "json": "application/json"}
"""What is offered, best first."""


def choose_form(accept: str | None) -> Form:
    """The offered form that an ``Accept`` header likes best; the first offered one if it likes several equally.

    Raises:
        ProblemError: 406 if it takes none of them.
    """
    ranges = [_parse(item) for item in (accept or "*/*").split(",") if item.strip()]
    best: Form | None = None
    liked = 0.0
    for form, media_type in MEDIA_TYPES.items():
        quality = _quality(media_type, ranges)
        if quality > liked:
            best, liked = form, quality
    if best is None:
        offered = ", ".join(MEDIA_TYPES.values())
        raise ProblemError(406, "form-not-offered", f"Accept is {(accept or '')[:100]!r}; offered are {offered}")
    return best


def _parse(item: str) -> tuple[str, float]:
    media_range, *parameters = (part.strip().lower() for part in item.split(";"))
    quality = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                quality = min(1.0, max(0.0, float(value)))
            except ValueError:
                quality = 0.0
    return media_range, quality


def _quality(media_type: str, ranges: list[tuple[str, float]]) -> float:
    """Quality of a type: that of the most exact range that covers it."""
    for covering in (media_type, media_type.partition("/")[0] + "/*", "*/*"):
        found = [quality for media_range, quality in ranges if media_range == covering]
        if found:
            return max(found)
    return 0.0

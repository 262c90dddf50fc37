"""``/healthz``, ``/readyz`` and ``/bundle``: is it alive, can it work, and what with."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from bathyscope.bundle import Bundle, BundleManifest
from bathyscope_serve.problems import MEDIA_TYPE, ProblemError
from bathyscope_serve.service import DepthService

router = APIRouter()


class Health(BaseModel):
    """The answer of a service that is well."""

    status: Literal["ok"] = "ok"


class BundleInfo(BaseModel):
    """The model in use."""

    digest: str = Field(description="SHA-256 of the manifest, as results carry it.")
    manifest: BundleManifest


_NOT_READY = {
    "description": "The model is not warm yet, or could not be started.",
    "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
}


@router.get("/healthz")
async def health() -> Health:
    """The process answers."""
    return Health()


@router.get("/readyz", responses={503: _NOT_READY})
async def readiness(request: Request) -> Health:
    """The model is warm and clips are taken."""
    service: DepthService = request.app.state.service
    if service.state != "ready":
        raise ProblemError(503, "not-ready", f"the service is {service.state}", headers={"Retry-After": "1"})
    return Health()


@router.get("/bundle")
async def bundle(request: Request) -> BundleInfo:
    """The model in use: hashes, provenance, licence, parity and accuracy."""
    service: DepthService = request.app.state.service
    model = service.engine.bundle
    assert isinstance(model, Bundle), "a service runs a bundle"
    return BundleInfo(digest=model.digest, manifest=model.manifest)

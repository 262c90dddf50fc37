"""The HTTP application: routes, limits, problems, and the service behind them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from bathyscope.engines import Engine
from bathyscope_serve import problems
from bathyscope_serve.body_limits import BodyLimits
from bathyscope_serve.request_context import RequestContext
from bathyscope_serve.routes import depth, docs, status
from bathyscope_serve.service import DepthService
from bathyscope_serve.settings import ServiceSettings

_ABOUT = (
    "Depth maps and camera poses, consistent in one 3-D world, from monocular endoscopic video. Not a medical device."
)


def create_app(engine: Engine, settings: ServiceSettings | None = None) -> FastAPI:
    """The ASGI application around a loaded engine; it warms the engine up when the server starts it."""
    settings = settings or ServiceSettings()
    service = DepthService(engine, settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await service.start()
        try:
            yield
        finally:
            await service.stop()

    app = FastAPI(
        title="Bathyscope", description=_ABOUT, version=version("bathyscope"), docs_url=None, redoc_url=None,
        lifespan=lifespan,
    )  # fmt: skip
    app.state.service = service
    for module in (depth, status, docs):
        app.include_router(module.router)
    problems.install(app)
    app.add_middleware(
        BodyLimits,
        max_bytes=settings.max_upload_bytes,
        timeout_s=settings.receive_timeout_s,
        send_timeout_s=settings.send_timeout_s,
    )
    app.add_middleware(RequestContext)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    """FastAPI's description, plus the models that only hand-written responses name."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = schema.setdefault("components", {}).setdefault("schemas", {})
        for model in depth.SCHEMAS:
            described = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(described.pop("$defs", {}))
            schemas[model.__name__] = described
        app.openapi_schema = schema
    return app.openapi_schema

"""The application: routers, errors, middleware, lifetime."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import APIRouter, FastAPI
from starlette.concurrency import run_in_threadpool

from prtbake_service import errors_http
from prtbake_service.artefacts.endpoints import router as artefacts
from prtbake_service.auth import ensure_key
from prtbake_service.backend import Backend
from prtbake_service.health.endpoints import router as health
from prtbake_service.health.metrics import Metrics
from prtbake_service.jobs.endpoints import router as jobs
from prtbake_service.middleware import RequestContext
from prtbake_service.pages.endpoints import router as pages
from prtbake_service.pages.endpoints import static_files
from prtbake_service.resources.endpoints import brdfs, environments, meshes
from prtbake_service.settings import ServiceSettings
from prtbake_service.uploads.endpoints import router as uploads
from prtbake_storage import __version__
from prtbake_storage.queue.reconcile import Reconciler

_PROBLEMS: dict[int | str, dict[str, Any]] = {
    status: {
        "description": "A problem (RFC 9457)",
        "content": {errors_http.PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
    for status in ("4XX", "5XX")
}


def create_app(settings: ServiceSettings) -> FastAPI:
    """Build the application; storage is opened when it starts and closed when it ends."""
    metrics = Metrics()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        backend = await run_in_threadpool(Backend.open, settings, metrics)
        reconciler = Reconciler(
            backend.database,
            backend.queue,
            every_s=settings.reconcile_every.total_seconds(),
            dead_after_s=settings.worker_dead_after.total_seconds(),
        )
        try:
            await run_in_threadpool(ensure_key, backend)
            metrics.watch(backend.jobs.counts, backend.workers_alive)
            app.state.backend = backend
            await run_in_threadpool(reconciler.start)
            try:
                yield
            finally:
                await run_in_threadpool(reconciler.stop)
        finally:
            await run_in_threadpool(backend.close)

    app = FastAPI(
        title="prtbake",
        version=__version__,
        summary="Bake, compress and relight precomputed radiance transfer.",
        openapi_url="/v1/openapi.json",
        # the stock pages load scripts from elsewhere
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    api: list[APIRouter] = [jobs, artefacts, uploads, meshes, brdfs, environments]
    for router in api:
        app.include_router(router, responses=_PROBLEMS)
    app.include_router(health)
    app.include_router(pages)
    app.mount("/static", static_files, name="static")
    errors_http.install(app)
    app.add_middleware(
        RequestContext, metrics=metrics, max_request_bytes=settings.max_request_bytes
    )
    return app

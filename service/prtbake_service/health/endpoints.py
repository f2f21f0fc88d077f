"""``/healthz``, ``/readyz`` and ``/metrics``: open to all who can reach the port."""

import logging
from collections.abc import Callable

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST

from prtbake_service.backend import BackendDep
from prtbake_service.errors_http import RETRY_AFTER_S

router = APIRouter(tags=["health"])
log = logging.getLogger(__name__)


@router.get("/healthz")
async def healthz() -> dict[str, str]:
    """Tell that the process answers."""
    # in the event loop: requests that wait for the database may hold every thread
    return {"status": "ok"}


@router.get("/readyz")
def readyz(backend: BackendDep, response: Response) -> dict[str, str | int]:
    """Tell whether jobs can be taken: 503 when database or blobs cannot be used.

    Without a worker jobs are still taken; they wait.
    """
    checks: dict[str, str | int] = {
        "database": _check("database", backend.workers_alive),
        "blobs": _check("blobs", lambda: _touch(backend)),
    }
    ready = set(checks.values()) == {"ok"}
    if checks["database"] == "ok":
        checks["workers"] = backend.workers_alive()
    if not ready:
        response.status_code = 503
        response.headers["Retry-After"] = RETRY_AFTER_S
    return {"status": "ready" if ready else "not ready"} | checks


@router.get("/metrics")
def metrics(backend: BackendDep) -> Response:
    """Numbers for Prometheus."""
    return Response(backend.metrics.render(), media_type=CONTENT_TYPE_LATEST)


def _touch(backend: BackendDep) -> None:
    with backend.blobs.scratch():
        pass


def _check(name: str, action: Callable[[], object]) -> str:
    # details go to the log: this page is open to all
    try:
        action()
    except Exception:
        log.exception("ready.failed", extra={"part": name})
        return "failed"
    return "ok"

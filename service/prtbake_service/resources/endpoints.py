"""``/v1/meshes``, ``/v1/brdfs`` and ``/v1/environments``: one set of endpoints, three nouns."""

from collections.abc import Callable
from datetime import timedelta
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Response
from starlette.concurrency import run_in_threadpool

from prtbake_service.auth import Caller
from prtbake_service.backend import Backend, BackendDep
from prtbake_service.jobs.endpoints import PAGE, PAGE_MAX, RETRY_AFTER
from prtbake_service.resources.service import Registration, ResourceService, refusal_of
from prtbake_service.waiting import preferred_wait, wait_until
from prtbake_storage.contract.resources import (
    BrdfRegistration,
    EnvironmentRegistration,
    MeshRegistration,
    Resource,
    ResourceKind,
    ResourcePage,
)

POLL = timedelta(milliseconds=50)
"""Parsing takes tenths of a second and somebody waits for it."""
ResourceIdPath = Annotated[str, Path(pattern=r"^[a-z]+-[0-9a-f]{16}$")]
Prefer = Annotated[str | None, Header(max_length=200, description="wait=SECONDS")]
meshes = APIRouter(prefix="/v1/meshes", tags=["meshes"])
brdfs = APIRouter(prefix="/v1/brdfs", tags=["brdfs"])
environments = APIRouter(prefix="/v1/environments", tags=["environments"])
_POST: dict[str, Any] = {
    "status_code": 201,
    "responses": {200: {"model": Resource}, 202: {"model": Resource}},
}


@meshes.post("", **_POST)
async def register_mesh(
    registration: MeshRegistration,
    backend: BackendDep,
    caller: Caller,
    response: Response,
    prefer: Prefer = None,
) -> Resource:
    """Parse a mesh and tell what was understood: counts, extents, repairs."""
    service = ResourceService(backend, caller.project, "mesh")
    at_most = preferred_wait(prefer, backend.settings)
    return await _register(service, registration, backend, response, "/v1/meshes", at_most)


@brdfs.post("", **_POST)
async def register_brdf(
    registration: BrdfRegistration,
    backend: BackendDep,
    caller: Caller,
    response: Response,
    prefer: Prefer = None,
) -> Resource:
    """Check a BRDF and tell what was understood: model, energy, reciprocity."""
    service = ResourceService(backend, caller.project, "brdf")
    at_most = preferred_wait(prefer, backend.settings)
    return await _register(service, registration, backend, response, "/v1/brdfs", at_most)


@environments.post("", **_POST)
async def register_environment(
    registration: EnvironmentRegistration,
    backend: BackendDep,
    caller: Caller,
    response: Response,
    prefer: Prefer = None,
) -> Resource:
    """Parse an environment and tell what was understood: layout, dynamic range, repairs."""
    service = ResourceService(backend, caller.project, "environment")
    at_most = preferred_wait(prefer, backend.settings)
    return await _register(service, registration, backend, response, "/v1/environments", at_most)


async def _register(
    service: ResourceService,
    registration: Registration,
    backend: Backend,
    response: Response,
    path: str,
    at_most: timedelta,
) -> Resource:
    resource, is_new = await run_in_threadpool(service.register, registration)
    resource = await wait_until(
        lambda: service.get(resource.id),
        _is_parsed,
        closing=backend.closing,
        at_most=at_most,
        every=POLL,
    )
    response.headers["Location"] = f"{path}/{resource.id}"
    match resource.state:
        case "refused":
            raise refusal_of(resource)
        case "parsing":
            response.status_code = 202
            response.headers.update(RETRY_AFTER)
        case "ready":
            response.status_code = 201 if is_new else 200
    return resource


def _is_parsed(resource: Resource) -> bool:
    return resource.state != "parsing"


def _reader(kind: ResourceKind) -> Callable[..., object]:
    async def read(
        resource_id: ResourceIdPath,
        backend: BackendDep,
        caller: Caller,
        wait: Annotated[float, Query(ge=0, description="seconds to wait for parsing")] = 0.0,
    ) -> Resource:
        """Read one, waiting for its parsing to end if asked; a refused one says why."""
        service = ResourceService(backend, caller.project, kind)
        return await wait_until(
            lambda: service.get(resource_id),
            _is_parsed,
            closing=backend.closing,
            at_most=min(timedelta(seconds=min(wait, 3600.0)), backend.settings.long_poll_max),
            every=backend.settings.poll_every,
        )

    return read


def _lister(kind: ResourceKind) -> Callable[..., object]:
    def list_all(
        backend: BackendDep,
        caller: Caller,
        cursor: Annotated[str | None, Query(max_length=300)] = None,
        limit: Annotated[int, Query(ge=1, le=PAGE_MAX)] = PAGE,
    ) -> ResourcePage:
        """List all, newest first."""
        return ResourceService(backend, caller.project, kind).page(cursor, limit)

    return list_all


_KINDS: tuple[tuple[APIRouter, ResourceKind, str], ...] = (
    (meshes, "mesh", "meshes"),
    (brdfs, "brdf", "brdfs"),
    (environments, "environment", "environments"),
)
for _router, _kind, _plural in _KINDS:
    _router.get("/{resource_id}", name=f"get_{_kind}", response_model=Resource)(_reader(_kind))
    _router.get("", name=f"list_{_plural}", response_model=ResourcePage)(_lister(_kind))

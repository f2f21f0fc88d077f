"""``/v1/meshes``, ``/v1/brdfs`` and ``/v1/environments``: one set of endpoints, three nouns."""

from collections.abc import Callable
from datetime import timedelta
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Response
from starlette.concurrency import run_in_threadpool

from prtbake_service.auth import Caller
from prtbake_service.backend import BackendDep
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


class Registrar:
    """Registers on behalf of one request: stores, waits for the parsing, and sets the status."""

    def __init__(
        self, backend: BackendDep, caller: Caller, response: Response, prefer: Prefer = None
    ) -> None:
        self._backend, self._project, self._response = backend, caller.project, response
        self._at_most = preferred_wait(prefer, backend.settings)

    async def register(
        self, kind: ResourceKind, registration: Registration, *, below: APIRouter
    ) -> Resource:
        """Answer 201 or 200 with what was understood, 202 if parsing takes longer, or refuse."""
        service = ResourceService(self._backend, self._project, kind)
        resource, is_new = await run_in_threadpool(service.register, registration)
        resource = await wait_until(
            lambda: service.get(resource.id),
            _is_parsed,
            closing=self._backend.closing,
            at_most=self._at_most,
            every=POLL,
        )
        self._response.headers["Location"] = f"{below.prefix}/{resource.id}"
        match resource.state:
            case "refused":
                raise refusal_of(resource)
            case "parsing":
                self._response.status_code = 202
                self._response.headers.update(RETRY_AFTER)
            case "ready":
                self._response.status_code = 201 if is_new else 200
        return resource


RegistrarDep = Annotated[Registrar, Depends()]


@meshes.post("", **_POST)
async def register_mesh(registration: MeshRegistration, registrar: RegistrarDep) -> Resource:
    """Parse a mesh and tell what was understood: counts, extents, repairs."""
    return await registrar.register("mesh", registration, below=meshes)


@brdfs.post("", **_POST)
async def register_brdf(registration: BrdfRegistration, registrar: RegistrarDep) -> Resource:
    """Check a BRDF and tell what was understood: model, energy, reciprocity."""
    return await registrar.register("brdf", registration, below=brdfs)


@environments.post("", **_POST)
async def register_environment(
    registration: EnvironmentRegistration, registrar: RegistrarDep
) -> Resource:
    """Parse an environment and tell what was understood: layout, dynamic range, repairs."""
    return await registrar.register("environment", registration, below=environments)


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

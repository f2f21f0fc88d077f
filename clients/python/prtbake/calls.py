"""Requests and the reading of their answers, without I/O: shared by both clients."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from uuid import uuid4

import httpx
from pydantic import BaseModel

from prtbake_storage.contract.jobs import (
    AnyRequest,
    Artefact,
    ArtefactManifest,
    Estimate,
    Job,
    JobPage,
)
from prtbake_storage.contract.resources import (
    BrdfRegistration,
    EnvironmentRegistration,
    MeshRegistration,
    MissingResponse,
    Resource,
    Upload,
)

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

JobSpec = AnyRequest | Mapping[str, Any]
"""A job request as a model or as plain JSON (checked by the service)."""

Registration = MeshRegistration | BrdfRegistration | EnvironmentRegistration
COLLECTIONS: Mapping[str, str] = {
    "mesh": "meshes",
    "brdf": "brdfs",
    "environment": "environments",
}


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request and how to read its answer.

    Attributes
    ----------
    repeatable
        Whether sending it twice does what sending it once does, so that a lost answer may be
        asked for again.
    """

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    body: Any = None
    params: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    repeatable: bool = True


def _model(cls: type[M]) -> Callable[[httpx.Response], M]:
    return lambda response: cls.model_validate_json(response.content)


def _nothing(response: httpx.Response) -> None:
    del response


def _plain(value: BaseModel | Mapping[str, Any]) -> Any:
    return value.model_dump(mode="json") if isinstance(value, BaseModel) else dict(value)


def submit_job(
    request: JobSpec, *, job_id: str | None = None, idempotency_key: str | None = None
) -> Call[Job]:
    """Submit a job, under an id of the caller's choice if one is given."""
    if job_id is not None:
        return Call("PUT", f"/v1/jobs/{job_id}", _model(Job), _plain(request))
    headers = {"Idempotency-Key": idempotency_key or uuid4().hex}
    return Call("POST", "/v1/jobs", _model(Job), _plain(request), headers=headers)


def estimate_job(request: JobSpec) -> Call[httpx.Response]:
    """Ask what a job would do and cost; 202 says where the answer will stand."""
    return Call("POST", "/v1/jobs:estimate", lambda response: response, _plain(request))


def get_job(
    job_id: str, *, wait_s: float | None = None, etag: str | None = None
) -> Call[tuple[Job | None, str | None]]:
    """Read a job and its ETag; None for the job when it is still as ``etag`` names it."""
    return Call(
        "GET",
        f"/v1/jobs/{job_id}",
        lambda r: (
            None if r.status_code == 304 else Job.model_validate_json(r.content),
            r.headers.get("etag"),
        ),
        params={} if wait_s is None else {"wait": wait_s},
        headers={} if etag is None else {"If-None-Match": etag},
    )


def list_jobs(
    *,
    state: list[str] | None = None,
    kind: str | None = None,
    label: str | None = None,
    cursor: str | None = None,
    limit: int | None = None,
) -> Call[JobPage]:
    """Read one page of jobs, newest first."""
    given = {"state": state, "kind": kind, "label": label, "cursor": cursor, "limit": limit}
    params = {name: value for name, value in given.items() if value is not None}
    return Call("GET", "/v1/jobs", _model(JobPage), params=params)


def cancel_job(job_id: str) -> Call[Job]:
    """Ask for a job to stop."""
    return Call("POST", f"/v1/jobs/{job_id}/cancel", _model(Job))


def retry_job(job_id: str) -> Call[Job]:
    """Start a new job that goes on from the last finished tile of one that did not succeed."""
    headers = {"Idempotency-Key": uuid4().hex}
    return Call("POST", f"/v1/jobs/{job_id}/retry", _model(Job), headers=headers)


def delete_job(job_id: str) -> Call[None]:
    """Remove a job that has ended, and its artefacts."""
    return Call("DELETE", f"/v1/jobs/{job_id}", _nothing, repeatable=False)


def list_artefacts(job_id: str) -> Call[list[Artefact]]:
    """Read the manifest of a job's files."""
    return Call(
        "GET",
        f"/v1/jobs/{job_id}/artefacts",
        lambda r: ArtefactManifest.model_validate_json(r.content).items,
    )


def artefact_path(job_id: str, name: str) -> str:
    """Return the path that a file is downloaded from."""
    return f"/v1/jobs/{job_id}/artefacts/{name}"


def missing_uploads(digests: list[str]) -> Call[MissingResponse]:
    """Ask which of some digests the service does not hold."""
    return Call("POST", "/v1/uploads/missing", _model(MissingResponse), {"digests": digests})


def read_upload(response: httpx.Response) -> Upload:
    """Read the answer to an upload."""
    return Upload.model_validate_json(response.content)


def register(registration: Registration) -> Call[Resource]:
    """Name a blob as a mesh, BRDF or environment, and have it parsed."""
    match registration:
        case MeshRegistration():
            kind = "mesh"
        case BrdfRegistration():
            kind = "brdf"
        case EnvironmentRegistration():
            kind = "environment"
    body = registration.model_dump(mode="json", exclude_none=True)
    return Call("POST", f"/v1/{COLLECTIONS[kind]}", _model(Resource), body)


def get_resource(resource_id: str, *, wait_s: float | None = None) -> Call[Resource]:
    """Read a resource, waiting for its parsing to end if asked."""
    kind = resource_id.partition("-")[0]
    return Call(
        "GET",
        f"/v1/{COLLECTIONS.get(kind, 'meshes')}/{resource_id}",
        _model(Resource),
        params={} if wait_s is None else {"wait": wait_s},
    )


def read_estimate(response: httpx.Response) -> Estimate:
    """Read a finished estimate."""
    return Estimate.model_validate_json(response.content)

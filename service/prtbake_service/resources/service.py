"""Registering inputs: a resource row and the quick job that parses it."""

from prtbake_service.backend import Backend
from prtbake_service.errors_http import ProblemError
from prtbake_service.jobs.references import Resolver
from prtbake_service.jobs.service import (
    PARSE_PREFIX,
    QUICK_TIMEOUT_S,
    enqueue,
    status_of,
)
from prtbake_storage.blobs.base import json_digest
from prtbake_storage.contract.resources import (
    BrdfRegistration,
    EnvironmentRegistration,
    MeshRegistration,
    Resource,
    ResourceKind,
    ResourcePage,
)
from prtbake_storage.errors import NotFound, PrtError
from prtbake_storage.records import NewJob
from prtbake_storage.records.resources import CONTEXT_KEY

Registration = MeshRegistration | BrdfRegistration | EnvironmentRegistration
PARSE_PRIORITY = 10  # a person waits for it; lower is sooner


class ResourceService:
    """The meshes, BRDFs or environments of one project."""

    def __init__(self, backend: Backend, project: str, kind: ResourceKind) -> None:
        self._backend = backend
        self._project = project
        self._kind: ResourceKind = kind

    def get(self, resource_id: str) -> Resource:
        """Look a resource up."""
        resource = self._backend.resources.get(resource_id, project=self._project)
        if resource.kind != self._kind:
            raise NotFound(f"there is no {self._kind} {resource_id}")
        return resource

    def page(self, cursor: str | None, limit: int) -> ResourcePage:
        """List resources, newest first."""
        return self._backend.resources.page(
            project=self._project, kind=self._kind, cursor=cursor, limit=limit
        )

    def register(self, registration: Registration) -> tuple[Resource, bool]:
        """Make a resource and start to parse it; tell whether it is new.

        The same registration gives the same resource.  One that was refused is parsed again, since
        the parser may have learned since, and so is one whose canonical blob is gone.
        """
        if registration.blob is not None:
            Resolver(self._backend, self._project).require_upload(registration.blob, "/blob")
        request = registration.model_dump(mode="json")
        resource_id = self._id(request)
        begun = self._backend.registrations.begin(
            resource_id,
            self._kind,
            request,
            self._parser(resource_id, request),
            project=self._project,
            label=registration.label,
            again=self._is_lost(resource_id),
        )
        if begun.job is not None:
            enqueue(self._backend, begun.job)
        return begun.resource, begun.is_new

    def _is_lost(self, resource_id: str) -> bool:
        try:
            canonical = self.get(resource_id).canonical
        except NotFound:
            return False
        return canonical is not None and not self._backend.blobs.exists(canonical)

    def _id(self, request: dict[str, object]) -> str:
        # what a resource is called does not change what it is
        named = {"project": self._project} | {k: v for k, v in request.items() if k != "label"}
        return f"{self._kind}-{json_digest(named)[:16]}"

    def _parser(self, resource_id: str, request: dict[str, object]) -> NewJob:
        return NewJob(
            id=f"{PARSE_PREFIX}{resource_id}",
            kind="register",
            request={"resource_kind": self._kind, "registration": request},
            context={CONTEXT_KEY: resource_id},
            project=self._project,
            internal=True,
            quick=True,
            priority=PARSE_PRIORITY,
            timeout_s=QUICK_TIMEOUT_S,
        )


def refusal_of(resource: Resource) -> PrtError:
    """Return why a resource cannot be used, as the error of the request that made it."""
    problem = resource.problem or {}
    code = str(problem.get("code", "refused"))
    return ProblemError(
        status_of(str(problem.get("kind", "input")), code),
        code,
        str(problem.get("detail", "it could not be parsed")),
        pointer=problem.get("pointer"),
    )

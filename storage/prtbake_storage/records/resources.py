"""Meshes, BRDFs and environments that were registered."""

from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.contract.resources import Resource, ResourceKind, ResourcePage
from prtbake_storage.errors import NotFound
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import JobRow, ResourceRow
from prtbake_storage.records.pages import read_page

CONTEXT_KEY = "resource_id"
"""A job whose context has this key writes its outcome to that resource as well."""


class Resources:
    """Reads resources; `Registrations` makes them, and the end of a job settles them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, resource_id: str, *, project: str | None = None) -> Resource:
        """Look a resource up; `NotFound` if there is none, or it is another project's."""
        with self._database.read() as session:
            row = session.get(ResourceRow, resource_id)
            if row is None or (project is not None and row.project != project):
                raise NotFound(f"there is no resource {resource_id}")
            return to_resource(row)

    def page(
        self,
        *,
        project: str | None = None,
        kind: ResourceKind | None = None,
        cursor: str | None = None,
        limit: int = 20,
    ) -> ResourcePage:
        """List resources, newest first, ``limit`` a page."""
        filters = []
        if project is not None:
            filters.append(ResourceRow.project == project)
        if kind is not None:
            filters.append(ResourceRow.kind == kind)
        with self._database.read() as session:
            rows, more = read_page(session, ResourceRow, filters, cursor=cursor, limit=limit)
        return ResourcePage(items=[to_resource(row) for row in rows], next=more)


def settle_resource(session: Session, job: JobRow) -> None:
    """Write the outcome of a registration job to its resource, in the transaction that ends it."""
    resource_id = job.context.get(CONTEXT_KEY)
    row = session.get(ResourceRow, resource_id) if resource_id else None
    if row is None:
        return
    if job.state == JobState.succeeded and job.result is not None:
        row.state = "ready"
        row.canonical = job.result.get("canonical")
        row.understood = job.result.get("understood", {})
        row.problem = None
    else:
        row.state = "refused"
        row.problem = job.error or {
            "kind": "internal",
            "code": job.state,
            "detail": f"parsing was {job.state}: register it again",
            "pointer": None,
        }


def to_resource(row: ResourceRow) -> Resource:
    """Show a resource."""
    return Resource.model_validate(
        {
            "id": row.id,
            "kind": row.kind,
            "state": row.state,
            "label": row.label,
            "created": row.created,
            "request": row.request,
            "understood": row.understood,
            "canonical": row.canonical,
            "problem": row.problem,
        }
    )

"""Meshes, BRDFs and environments that were registered."""

from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.contract.resources import Resource, ResourceKind, ResourcePage
from prtbake_storage.errors import NotFound
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import JobRow, ResourceRow
from prtbake_storage.records.pages import read_page

CONTEXT_KEY = "resource_id"
"""A job whose context has this key writes its outcome to that resource as well."""


class Resources:
    """Reads and writes resources."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self,
        resource_id: str,
        kind: ResourceKind,
        request: dict[str, Any],
        *,
        project: str = "default",
        label: str | None = None,
    ) -> tuple[Resource, bool]:
        """Insert a resource in state ``parsing``, or find the one with this id.

        Returns
        -------
        tuple
            The resource, and whether it is new.
        """
        row = ResourceRow(
            id=resource_id,
            project=project,
            kind=kind,
            state="parsing",
            label=label,
            request=request,
            understood={},
            created=utc_now(),
        )
        try:
            with self._database.write() as session:
                session.add(row)
        except IntegrityError:
            return self.get(resource_id, project=project), False
        return to_resource(row), True

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

    def ready(self, resource_id: str, *, canonical: str, understood: dict[str, Any]) -> None:
        """Record what was understood; a resource parsed again may turn from refused to ready."""
        self._set(resource_id, state="ready", canonical=canonical, understood=understood)

    def refuse(self, resource_id: str, problem: dict[str, Any]) -> None:
        """Record why a resource cannot be used."""
        self._set(resource_id, state="refused", problem=problem)

    def parse_again(self, resource_id: str) -> None:
        """Set a refused resource back to ``parsing``."""
        self._set(resource_id, state="parsing", problem=None)

    def _set(self, resource_id: str, **values: Any) -> None:
        with self._database.write() as session:
            session.execute(
                sa.update(ResourceRow).where(ResourceRow.id == resource_id).values(**values)
            )


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

"""Beginning a registration: a resource and the job that parses it, in one transaction."""

import secrets
from dataclasses import dataclass, replace
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import TERMINAL
from prtbake_storage.contract.resources import Resource, ResourceKind
from prtbake_storage.errors import NotFound
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.jobs import NewJob, insert_job
from prtbake_storage.records.models import JobRow, ResourceRow
from prtbake_storage.records.resources import to_resource


@dataclass(frozen=True)
class Begun:
    """A registration: its resource, whether that is new, and the job to enqueue, if any."""

    resource: Resource
    is_new: bool
    job: NewJob | None


class Registrations:
    """Begins registrations.

    A resource in state ``parsing`` has a job that is not terminal: both are written here together,
    and the job's end settles the resource.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def begin(
        self,
        resource_id: str,
        kind: ResourceKind,
        request: dict[str, Any],
        job: NewJob,
        *,
        project: str = "default",
        label: str | None = None,
        again: bool = False,
    ) -> Begun:
        """Insert a resource with its job, or find it; one that was refused is parsed again.

        Parameters
        ----------
        job
            The job that parses; if its id was used up before it gets one that starts with it.
        again
            Parse a resource that is ready once more.
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
                session.flush()
                return Begun(to_resource(row), True, _begin_job(session, job))
        except IntegrityError:
            return self._take_up(resource_id, job, project, again=again)

    def _take_up(self, resource_id: str, job: NewJob, project: str, *, again: bool) -> Begun:
        with self._database.write() as session:
            # the lock puts two callers in line: the second finds the job of the first
            row = session.get(ResourceRow, resource_id, with_for_update=True)
            if row is None or row.project != project:
                raise NotFound(f"there is no resource {resource_id}")
            parsing = session.scalars(
                sa.select(JobRow.id).where(
                    JobRow.id.startswith(job.id, autoescape=True),
                    JobRow.state.not_in([state.value for state in TERMINAL]),
                )
            ).first()
            if parsing is not None or (row.state == "ready" and not again):
                return Begun(to_resource(row), False, None)
            row.state, row.problem = "parsing", None
            return Begun(to_resource(row), False, _begin_job(session, job))


def _begin_job(session: Session, job: NewJob) -> NewJob:
    if session.get(JobRow, job.id) is not None:
        job = replace(job, id=f"{job.id}-{secrets.token_hex(6)}")
    insert_job(session, job)
    return job

"""Jobs as the service sees them: submit, look up, list, cancel, delete."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import TERMINAL, Job, JobPage, JobState, Progress
from prtbake_storage.errors import Conflict, NotFound
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.events import append_event
from prtbake_storage.records.models import ArtefactRow, JobRow
from prtbake_storage.records.pages import read_page
from prtbake_storage.records.resources import settle_resource
from prtbake_storage.records.rows import to_job


@dataclass(frozen=True)
class NewJob:
    """A job to be submitted.

    Attributes
    ----------
    context
        What the workers need beside the request, resolved now: digests of meshes and so on.
    internal
        Hidden from lists (registrations, estimates).
    quick
        Runs on the quick queue, whose slot no long job can hold.
    body_digest
        Digest of what was given: the same key or id with something else is a `Conflict`.
    """

    id: str
    kind: str
    request: dict[str, Any]
    context: dict[str, Any] = field(default_factory=dict)
    project: str = "default"
    internal: bool = False
    quick: bool = False
    label: str | None = None
    priority: int = 50
    timeout_s: float | None = None
    retry_of: str | None = None
    idempotency_key: str | None = None
    body_digest: str | None = None


class Jobs:
    """Reads and writes jobs; every change of state is one compare-and-set."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, new: NewJob) -> tuple[Job, bool]:
        """Insert a queued job, or find the one that the same id or idempotency key made before.

        Returns
        -------
        tuple
            The job, and whether it is new.  `Conflict` if the earlier one had another body.
        """
        try:
            with self._database.write() as session:
                row = insert_job(session, new)
        except IntegrityError:
            job = self.earlier(
                project=new.project,
                job_id=new.id,
                idempotency_key=new.idempotency_key,
                body_digest=new.body_digest,
            )
            if job is None:
                raise Conflict(
                    f"job {new.id} was deleted at this moment: submit it again"
                ) from None
            return job, False
        return to_job(row), True

    def earlier(
        self,
        *,
        project: str,
        job_id: str | None,
        idempotency_key: str | None,
        body_digest: str | None,
        same: Callable[[Job], bool] = lambda _: False,
    ) -> Job | None:
        """Find the job that an id or idempotency key made before.

        `Conflict` if it had another body, or if the id is another project's.  ``same`` is asked
        where digests differ: one that an earlier version made may be of the same request.
        """
        with self._database.read() as session:
            row = None
            if idempotency_key is not None:  # = NULL would find any job that has none
                row = session.scalars(
                    sa.select(JobRow).where(
                        JobRow.project == project, JobRow.idempotency_key == idempotency_key
                    )
                ).first()
            if row is None and job_id is not None:
                row = session.get(JobRow, job_id)
            if row is None:
                return None
            if row.project != project:
                raise Conflict(f"the job id {job_id} is taken")
            job = to_job(row, _artefacts(session, [row.id])[row.id])
            if row.body_digest != body_digest and not same(job):
                raise Conflict(
                    f"job {row.id} was submitted with this id or idempotency key"
                    " and another request"
                )
            return job

    def get(self, job_id: str, *, project: str | None = None) -> Job:
        """Look a job up; `NotFound` if there is none, or it is another project's."""
        with self._database.read() as session:
            row = _find(session, job_id, project)
            return to_job(row, _artefacts(session, [row.id])[row.id])

    def page(
        self,
        *,
        project: str | None = None,
        states: Collection[JobState] = (),
        kinds: Collection[str] = (),
        label: str | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
        internal: bool = False,
        cursor: str | None = None,
        limit: int = 20,
    ) -> JobPage:
        """List jobs, newest first, ``limit`` a page; filters are combined by *and*."""
        filters = [JobRow.internal == internal]
        if project is not None:
            filters.append(JobRow.project == project)
        if states:
            filters.append(JobRow.state.in_([state.value for state in states]))
        if kinds:
            filters.append(JobRow.kind.in_(list(kinds)))
        if label is not None:
            filters.append(JobRow.label == label)
        if created_after is not None:
            filters.append(JobRow.created > created_after)
        if created_before is not None:
            filters.append(JobRow.created < created_before)
        with self._database.read() as session:
            rows, more = read_page(session, JobRow, filters, cursor=cursor, limit=limit)
            artefacts = _artefacts(session, [row.id for row in rows])
        return JobPage(items=[to_job(row, artefacts[row.id]) for row in rows], next=more)

    def counts(self) -> dict[str, int]:
        """How many jobs stand in each state."""
        with self._database.read() as session:
            rows = session.execute(sa.select(JobRow.state, sa.func.count()).group_by(JobRow.state))
            return {state.value: 0 for state in JobState} | {row[0]: row[1] for row in rows}

    def request_cancel(self, job_id: str, *, project: str | None = None) -> Job:
        """Cancel: a queued job at once, a running one as soon as its tasks have stopped.

        Asking again, or too late, changes nothing.
        """
        with self._database.write() as session:
            row = _find(session, job_id, project, lock=True)
            moves = {
                JobState.queued: JobState.canceled,
                JobState.running: JobState.cancel_requested,
            }
            if (target := moves.get(JobState(row.state))) is not None:
                row.state = target.value
                row.cause = "requested"
                row.revision += 1
                row.finished = utc_now() if target in TERMINAL else None
                append_event(session, job_id, "state", {"state": target.value})
                if target in TERMINAL:
                    settle_resource(session, row)
            session.flush()
            return to_job(row, _artefacts(session, [job_id])[job_id])

    def delete(self, job_id: str, *, project: str | None = None) -> None:
        """Remove a terminal job with its artefact rows and events; `Conflict` if it is not."""
        with self._database.write() as session:
            row = _find(session, job_id, project, lock=True)
            if JobState(row.state) not in TERMINAL:
                raise Conflict(f"job {job_id} is {row.state}: cancel it before deleting it")
            session.delete(row)


def insert_job(session: Session, new: NewJob) -> JobRow:
    """Insert a queued job inside the caller's transaction; an `IntegrityError` if it is there."""
    row = JobRow(
        id=new.id,
        project=new.project,
        kind=new.kind,
        internal=new.internal,
        quick=new.quick,
        state=JobState.queued.value,
        revision=1,
        request=new.request,
        context=new.context,
        progress=Progress().model_dump(mode="json"),
        label=new.label,
        priority=new.priority,
        timeout_s=new.timeout_s,
        retry_of=new.retry_of,
        idempotency_key=new.idempotency_key,
        body_digest=new.body_digest,
        created=utc_now(),
    )
    session.add(row)
    session.flush()
    append_event(session, new.id, "state", {"state": JobState.queued.value})
    return row


def _find(session: Session, job_id: str, project: str | None, *, lock: bool = False) -> JobRow:
    row = session.get(JobRow, job_id, with_for_update=lock)
    if row is None or (project is not None and row.project != project):
        raise NotFound(f"there is no job {job_id}")
    return row


def _artefacts(session: Session, job_ids: Collection[str]) -> dict[str, list[ArtefactRow]]:
    found: dict[str, list[ArtefactRow]] = {job_id: [] for job_id in job_ids}
    for row in session.scalars(
        sa.select(ArtefactRow)
        .where(ArtefactRow.job_id.in_(list(job_ids)))
        .order_by(ArtefactRow.job_id, ArtefactRow.position)
    ):
        found[row.job_id].append(row)
    return found

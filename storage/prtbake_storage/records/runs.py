"""Jobs as the workers see them: start, look whether to stop, report progress, finish.

A run is idempotent: it may start again after its worker died, and two workers may for a moment run
the same job.  Each change is a compare-and-set against the states it may follow, so that one of
them wins and the other learns of it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, NamedTuple

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import TERMINAL, JobError, JobState, Progress
from prtbake_storage.contract.rates import NewRates
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.cost_rates import learn
from prtbake_storage.records.database import Database
from prtbake_storage.records.events import append_event, thin_progress
from prtbake_storage.records.models import ArtefactRow, JobRow, TaskProgressRow
from prtbake_storage.records.resources import settle_resource
from prtbake_storage.records.transitions import before

EndState = Literal[JobState.failed, JobState.canceled, JobState.expired]

_UNFINISHED = JobRow.state.not_in([state.value for state in TERMINAL])


@dataclass(frozen=True)
class Run:
    """What a worker needs to run a job."""

    job_id: str
    kind: str
    request: dict[str, Any]
    context: dict[str, Any]
    priority: int
    quick: bool
    started: datetime
    fraction: float


@dataclass(frozen=True)
class Stop:
    """Why a job's tasks must stop now, and how the job will end."""

    state: JobState
    error: JobError | None = None


class NewArtefact(NamedTuple):
    """A file for the manifest."""

    name: str
    media_type: str
    digest: str
    size: int


class Unfinished(NamedTuple):
    """A job that is not terminal, as the reconciler sees it."""

    job_id: str
    state: JobState
    quick: bool
    priority: int


class Given(NamedTuple):
    """What a job that is not terminal was given."""

    job_id: str
    kind: str
    request: dict[str, Any]
    context: dict[str, Any]


class TaskProgress(NamedTuple):
    """How far one running task is."""

    position: int
    done: float
    total: float
    unit: str


class Runs:
    """Moves jobs through their states."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def start(self, job_id: str) -> Run | None:
        """Mark a queued job running, or take up one that already runs; None if it has ended."""
        with self._database.write() as session:
            row = session.get(JobRow, job_id, with_for_update=True)
            if row is None or JobState(row.state) in TERMINAL:
                return None
            if row.state == JobState.queued:
                row.started = utc_now()
                if row.timeout_s is not None:
                    now = session.scalar(sa.select(self._database.seconds))
                    row.deadline_s = float(now or 0.0) + row.timeout_s
                _move(session, row, JobState.running)
            return Run(
                job_id=row.id,
                kind=row.kind,
                request=row.request,
                context=_with_start(row.context, row.started),
                priority=row.priority,
                quick=row.quick,
                started=row.started or utc_now(),
                fraction=float(row.progress.get("fraction", 0.0)),
            )

    def stop(self, job_id: str) -> Stop | None:
        """Tell why the job's tasks must stop now, or None: one indexed read, cheap to repeat."""
        late = JobRow.deadline_s < self._database.seconds
        with self._database.read() as session:
            row = session.execute(
                sa.select(
                    JobRow.state, JobRow.stopping, JobRow.error, JobRow.timeout_s, late
                ).where(JobRow.id == job_id)
            ).first()
        if row is None:
            return Stop(JobState.canceled)
        state, stopping, error, timeout_s, is_late = row
        if state == JobState.cancel_requested:
            return Stop(JobState.canceled)
        if state != JobState.running and state != JobState.queued:
            return Stop(JobState(state), JobError.model_validate(error) if error else None)
        if stopping is not None:
            return Stop(JobState(stopping["state"]), JobError.model_validate(stopping["error"]))
        if is_late:
            detail = f"it did not end within its time limit of {timeout_s:g} s"
            return Stop(
                JobState.expired, JobError(kind="resource", code="time-limit", detail=detail)
            )
        return None

    def fail_soon(self, job_id: str, error: JobError) -> None:
        """Note that a running job has failed: its other tasks stop, then `close` ends it."""
        with self._database.write() as session:
            session.execute(
                sa.update(JobRow)
                .where(
                    JobRow.id == job_id,
                    JobRow.state == JobState.running,
                    JobRow.stopping.is_(None),
                )
                .values(
                    stopping={"state": JobState.failed.value, "error": error.model_dump()},
                )
            )

    def progress(self, job_id: str, progress: Progress) -> None:
        """Record where a running job stands; the fraction never falls."""
        with self._database.write() as session:
            row = session.get(JobRow, job_id, with_for_update=True)
            if row is None or row.state != JobState.running:
                return
            fraction = max(progress.fraction, float(row.progress.get("fraction", 0.0)))
            row.progress = progress.model_copy(update={"fraction": fraction}).model_dump(
                mode="json"
            )
            row.revision += 1
            append_event(session, job_id, "progress", row.progress)

    def task_progress(self, job_id: str, stage: int, progress: TaskProgress) -> None:
        """Record how far a running task is."""
        row = TaskProgressRow(
            job_id=job_id,
            stage=stage,
            position=progress.position,
            done=progress.done,
            total=progress.total,
            unit=progress.unit,
        )
        # two workers may run one task for a moment and insert at once, or the job is deleted: this
        # is for people only, and no task may fail for it
        with suppress(IntegrityError), self._database.write() as session:
            session.merge(row)

    def tasks_under_way(self, job_id: str, stage: int) -> list[TaskProgress]:
        """How far the tasks of a stage are, as far as they said."""
        with self._database.read() as session:
            rows = session.scalars(
                sa.select(TaskProgressRow)
                .where(TaskProgressRow.job_id == job_id, TaskProgressRow.stage == stage)
                .order_by(TaskProgressRow.position)
            )
            return [TaskProgress(row.position, row.done, row.total, row.unit) for row in rows]

    def succeed(
        self,
        job_id: str,
        *,
        result: dict[str, Any],
        artefacts: Sequence[NewArtefact],
        progress: Progress,
        rates: NewRates | None = None,
    ) -> bool:
        """Publish artefacts and success in one transaction; False if the job was stopped before.

        ``rates`` are learnt in the same transaction: once a job, however often it is run.
        """
        with self._database.write() as session:
            row = session.get(JobRow, job_id, with_for_update=True)
            if row is None or row.state != JobState.running or row.stopping is not None:
                return False
            for position, artefact in enumerate(artefacts):
                session.add(
                    ArtefactRow(
                        job_id=job_id,
                        name=artefact.name,
                        position=position,
                        size=artefact.size,
                        media_type=artefact.media_type,
                        digest=artefact.digest,
                    )
                )
            row.result = result
            row.progress = progress.model_copy(update={"fraction": 1.0}).model_dump(mode="json")
            _end(session, row, JobState.succeeded, None)
            if rates is not None:
                learn(session, job_id, rates)
            return True

    def close(self, job_id: str, stop: Stop, *, cause: str | None = None) -> bool:
        """End a job without success; False if its state does not allow that (any more)."""
        with self._database.write() as session:
            row = session.get(JobRow, job_id, with_for_update=True)
            if row is None or JobState(row.state) in TERMINAL:
                return False
            # a cancellation asked for wins over an error that came up while stopping
            asked = row.state == JobState.cancel_requested
            state = JobState.canceled if asked else stop.state
            if JobState(row.state) not in before(state):
                return False
            if cause is not None:
                row.cause = cause
            _end(session, row, state, None if asked else stop.error)
            return True

    def unfinished(self, *, page: int = 1000) -> Iterator[list[Unfinished]]:
        """Yield all jobs that are not terminal in pages: those to be cancelled first, then by age.

        Each page is a transaction of its own: what changes meanwhile may be missed or come twice.
        """
        stopping = JobRow.state == JobState.cancel_requested
        yield from self._pages(stopping, page)
        yield from self._pages(sa.and_(_UNFINISHED, sa.not_(stopping)), page)

    def _pages(self, chosen: sa.ColumnElement[bool], page: int) -> Iterator[list[Unfinished]]:
        query = (
            sa.select(JobRow.id, JobRow.state, JobRow.quick, JobRow.priority, JobRow.created)
            .where(chosen)
            .order_by(JobRow.created, JobRow.id)
            .limit(page)
        )
        after: sa.ColumnElement[bool] = sa.true()
        while True:
            with self._database.read() as session:
                rows = session.execute(query.where(after)).all()
            if not rows:
                return
            yield [Unfinished(row.id, JobState(row.state), *row[2:4]) for row in rows]
            last = rows[-1]
            same_time = sa.and_(JobRow.created == last.created, JobRow.id > last.id)
            after = sa.or_(JobRow.created > last.created, same_time)

    def given(self) -> list[Given]:
        """Tell what all jobs that are not terminal were given."""
        with self._database.read() as session:
            rows = session.execute(
                sa.select(
                    JobRow.id, JobRow.kind, JobRow.request, JobRow.context, JobRow.started
                ).where(_UNFINISHED)
            )
            return [
                Given(job_id, kind, request, _with_start(context, started))
                for job_id, kind, request, context, started in rows
            ]


def _with_start(context: dict[str, Any], started: datetime | None) -> dict[str, Any]:
    """Tell a job that may take so long when it began: ``started``, in seconds since 1970."""
    return context if started is None else context | {"started": started.timestamp()}


def _move(session: Session, row: JobRow, state: JobState) -> None:
    if JobState(row.state) not in before(state):
        raise ValueError(f"job {row.id} cannot go from {row.state} to {state}")
    row.state = state.value
    row.revision += 1
    data: dict[str, Any] = {"state": state.value}
    if row.error is not None:
        data["error"] = row.error
    append_event(session, row.id, "state", data)


def _end(session: Session, row: JobRow, state: JobState, error: JobError | None) -> None:
    row.error = error.model_dump() if error is not None else None
    row.stopping = None
    row.finished = utc_now()
    _move(session, row, state)
    session.execute(sa.delete(TaskProgressRow).where(TaskProgressRow.job_id == row.id))
    thin_progress(session, row.id)
    settle_resource(session, row)

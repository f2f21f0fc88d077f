"""The history of jobs, as server-sent events replay it."""

from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.orm import Session

from prtbake_storage.contract.jobs import Event
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import EventRow, JobRow
from prtbake_storage.records.rows import to_event

EventType = Literal["state", "progress", "log"]


def append_event(session: Session, job_id: str, kind: EventType, data: dict[str, Any]) -> None:
    """Add an event inside the caller's transaction.

    On PostgreSQL two transactions may commit in another order than they drew their ids, and a
    reader that had seen the later id would miss the earlier one for ever; holding the job's row
    puts the events of one job in line.
    """
    session.execute(sa.select(JobRow.id).where(JobRow.id == job_id).with_for_update())
    session.add(EventRow(job_id=job_id, type=kind, data=data, created=utc_now()))


def thin_progress(session: Session, job_id: str) -> None:
    """Leave of the progress of a job that has ended the last event of each stage and percent.

    While a job runs it tells of its progress every second; a day of that is 86,400 rows.
    """
    progress = sa.and_(EventRow.job_id == job_id, EventRow.type == "progress")
    percent = sa.cast(100.0 * EventRow.data["fraction"].as_float(), sa.Integer)
    last = sa.select(sa.func.max(EventRow.id)).where(progress)
    last = last.group_by(EventRow.data["stage_index"].as_integer(), percent)
    session.execute(sa.delete(EventRow).where(progress, EventRow.id.not_in(last)))


class Events:
    """Reads and writes events."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def append(self, job_id: str, kind: EventType, data: dict[str, Any]) -> None:
        """Add an event to a job that exists."""
        with self._database.write() as session:
            append_event(session, job_id, kind, data)

    def log(self, job_id: str, message: str, **fields: Any) -> None:
        """Add a line to a job's log."""
        self.append(job_id, "log", {"message": message, **fields})

    def after(self, job_id: str, last_id: int = 0, *, limit: int = 500) -> list[Event]:
        """Events of a job with ids above ``last_id``, oldest first."""
        with self._database.read() as session:
            rows = session.scalars(
                sa.select(EventRow)
                .where(EventRow.job_id == job_id, EventRow.id > last_id)
                .order_by(EventRow.id)
                .limit(limit)
            )
            return [to_event(row) for row in rows]

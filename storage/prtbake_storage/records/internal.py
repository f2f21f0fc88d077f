"""The service's own jobs that have ended: registrations and estimates, in no list."""

from collections.abc import Collection
from datetime import datetime

import sqlalchemy as sa

from prtbake_storage.contract.jobs import TERMINAL
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import JobRow

_ENDED = sa.and_(JobRow.internal, JobRow.state.in_([state.value for state in TERMINAL]))


class InternalJobs:
    """Finds and deletes them: what they found out has long been told, or is in their resources."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def ended(self, before: datetime) -> list[str]:
        """Ids of those that ended before a time, in no order."""
        with self._database.read() as session:
            ended = sa.select(JobRow.id).where(_ENDED, JobRow.finished < before)
            return list(session.scalars(ended))

    def delete(self, job_ids: Collection[str]) -> int:
        """Delete those of the jobs that are internal and have ended; returns how many."""
        with self._database.write() as session:
            doomed = sa.delete(JobRow).where(_ENDED, JobRow.id.in_(list(job_ids)))
            return len(session.scalars(doomed.returning(JobRow.id)).all())

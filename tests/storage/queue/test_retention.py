"""What time takes: ended workflows and the service's own ended jobs, and nothing else."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest
import sqlalchemy as sa

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.queue import retention
from prtbake_storage.queue.engine import JobQueue, engine_url
from prtbake_storage.queue.retention import let_go
from prtbake_storage.records import Database, Jobs, NewJob, Runs, Stop
from prtbake_storage.records.database import normalise_url
from prtbake_storage.records.models import EventRow, JobRow

NOW = datetime.now(UTC)
LONG_AGO, LIMIT = NOW - timedelta(days=30), NOW - timedelta(days=7)


@pytest.fixture
def queue(database_url: str) -> Iterator[JobQueue]:
    queue = JobQueue(database_url)
    yield queue
    queue.close()


def ended(database: Database, job_id: str, when: datetime, *, internal: bool) -> None:
    """Leave a job that ended at a time."""
    Jobs(database).create(NewJob(id=job_id, kind="toy", request={}, internal=internal))
    assert Runs(database).close(job_id, Stop(JobState.failed))
    with database.write() as session:
        session.get_one(JobRow, job_id).finished = when


def left(database: Database, table: sa.ColumnElement[str]) -> set[str]:
    with database.read() as session:
        return set(session.scalars(sa.select(table)))


def test_the_services_own_jobs_go_once_they_are_old(
    database: Database, queue: JobQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "BATCH", 2)  # so that there are several
    for index in range(5):
        ended(database, f"parse-{index}", LONG_AGO, internal=True)
    ended(database, "young", NOW, internal=True)
    ended(database, "callers", LONG_AGO, internal=False)
    Jobs(database).create(NewJob(id="waiting", kind="toy", request={}, internal=True))
    assert let_go(database, queue, ended_before=LIMIT) == 5
    assert left(database, JobRow.id) == {"young", "callers", "waiting"}
    assert left(database, EventRow.job_id) == {"young", "callers", "waiting"}
    assert let_go(database, queue, ended_before=LIMIT) == 0


def test_a_job_outlives_its_workflow(
    database: Database, database_url: str, queue: JobQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An id whose workflow is still there would be used anew, and its job not be run."""
    monkeypatch.setattr(retention, "BATCH", 2)
    names = [f"parse-{index}" for index in range(5)]
    for name in names:
        ended(database, name, LONG_AGO, internal=True)
        queue.submit(name, quick=True)
    queue.cancel(names)  # now, and so after the limit
    assert let_go(database, queue, ended_before=LIMIT) == 0
    assert left(database, JobRow.id) == set(names)
    engine = sa.create_engine(normalise_url(engine_url(database_url)))
    schema = "dbos." if engine.dialect.name == "postgresql" else ""
    with engine.begin() as connection:
        aged = f"UPDATE {schema}workflow_status SET completed_at = :ms"
        connection.execute(sa.text(aged), {"ms": int(LONG_AGO.timestamp() * 1000)})
    engine.dispose()
    assert let_go(database, queue, ended_before=LIMIT) == 10
    assert left(database, JobRow.id) == set()
    assert queue.statuses(names) == {}

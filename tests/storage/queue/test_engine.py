"""The queue from outside, on a real engine without workers."""

import base64
import os
import pickle
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

import prtbake_storage
from prtbake_storage.contract.jobs import JobError, JobState
from prtbake_storage.queue.engine import GIVEN_UP, JobQueue, engine_url
from prtbake_storage.queue.reconcile import MOST_RENEWALS, reconcile_once
from prtbake_storage.records import Database, Jobs, NewJob, Runs, Stop, Workers
from prtbake_storage.records.database import normalise_url
from prtbake_storage.records.models import JobRow


@pytest.fixture
def queue(database_url: str) -> Iterator[JobQueue]:
    queue = JobQueue(database_url)
    yield queue
    queue.close()


def test_the_engine_lies_beside_or_inside_the_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert engine_url("sqlite:////a/b/prtbake.sqlite") == "sqlite:////a/b/prtbake.sqlite-engine"
    url = "postgresql+psycopg://me:s%40cret@host:5432/db"
    assert engine_url(url) == "postgresql://me:s%40cret@host:5432/db"
    # one database has one engine, whatever it is called
    (tmp_path / "link.sqlite").symlink_to(tmp_path / "prtbake.sqlite")
    monkeypatch.chdir(tmp_path)
    names = ("prtbake.sqlite", "./prtbake.sqlite", "link.sqlite", str(tmp_path / "prtbake.sqlite"))
    assert len({engine_url(f"sqlite:///{name}") for name in names}) == 1


def test_two_databases_in_one_folder_share_no_work(tmp_path: Path) -> None:
    queues = [JobQueue(f"sqlite:///{tmp_path / name}") for name in ("a.sqlite", "a.db", "b.sqlite")]
    queues[0].submit("job")
    assert [queue.statuses(["job"]) for queue in queues] == [{"job": "ENQUEUED"}, {}, {}]
    for queue in queues:
        queue.close()


NO_ERROR = JobError(kind="internal", code="none", detail="")


def test_the_queue_and_the_reconciler_together(database: Database, queue: JobQueue) -> None:
    """One walk through all calls: setting the engine up costs more than using it."""
    jobs, runs = Jobs(database), Runs(database)
    for name in ("sent", "lost", "ended", "quick"):
        jobs.create(NewJob(id=name, kind="toy", request={}, quick=name == "quick"))

    # submitting twice is submitting once
    queue.submit("sent", priority=3)
    queue.submit("sent", priority=3)
    queue.submit("ended")
    assert queue.statuses(["sent", "lost", "ended"]) == {"sent": "ENQUEUED", "ended": "ENQUEUED"}
    assert queue.statuses([]) == {}

    # a lost submission is made up for, once
    assert reconcile_once(database, queue) == 2
    assert set(queue.statuses(["lost", "quick"])) == {"lost", "quick"}
    assert reconcile_once(database, queue) == 0

    # tasks share their job's prefix, and no other job's
    key = "0123456789abcdef" * 4
    first, second, other = (
        queue.submit_task(job, 0, position, {"x": 1}, key=key, priority=3)
        for job, position in (("sent", 0), ("sent", 1), ("sent2", 0))
    )
    assert first == queue.submit_task("sent", 0, 0, {"x": 1}, key=key, priority=3)
    assert queue.open_tasks("sent") == {first: "ENQUEUED", second: "ENQUEUED"}
    queue.cancel([first])
    assert queue.open_tasks("sent") == {second: "ENQUEUED"}
    # what the old code has ended is not in the new code's way
    renewed = queue.submit_task("sent", 0, 0, {"x": 1}, key=key[::-1], priority=3)
    assert queue.open_tasks("sent") == {renewed: "ENQUEUED", second: "ENQUEUED"}
    assert queue.claims(["nobody"]) == []

    # a queued row whose workflow has ended never ran: the workflow is an earlier job's, whose
    # deletion was cut short
    queue.cancel(["ended"])
    assert reconcile_once(database, queue) == 1
    assert jobs.get("ended").state == JobState.queued
    assert queue.statuses(["ended"]) == {"ended": "ENQUEUED"}
    assert reconcile_once(database, queue) == 0
    # a running row whose workflow was ended behind its back is closed
    runs.start("ended")
    queue.cancel(["ended"])
    assert reconcile_once(database, queue) == 1
    job = jobs.get("ended")
    assert (job.state, (job.error or NO_ERROR).code) == ("failed", "engine")

    # with nobody alive a wish to cancel is fulfilled at once; with a worker it is the worker's
    runs.start("sent")
    jobs.request_cancel("sent")
    Workers(database).beat("w", host="h", pid=1, tile_slots=1)
    assert reconcile_once(database, queue) == 0
    Workers(database).mark_gone("w")
    assert reconcile_once(database, queue) == 1
    assert jobs.get("sent").state == JobState.canceled

    # a terminal row is left alone, whatever the engine thinks
    runs.close("lost", Stop(JobState.failed, JobError(kind="internal", code="x", detail="y")))
    assert reconcile_once(database, queue) == 0

    # what is forgotten may be used anew
    queue.forget("sent")
    assert queue.statuses(["sent"]) == {}
    assert queue.open_tasks("sent") == {}
    assert queue.open_tasks("sent2") == {other: "ENQUEUED"}
    assert queue.prune("2000-01-01T00:00:00+00:00", limit=10) == 0
    assert queue.prune("2999-01-01T00:00:00+00:00", limit=10) == 1
    assert queue.statuses(["ended"]) == {}


def test_a_workflow_that_ends_before_its_job_begins_is_made_anew_a_few_times(
    database: Database, queue: JobQueue
) -> None:
    jobs, renewals = Jobs(database), Counter[str]()
    jobs.create(NewJob(id="cursed", kind="toy", request={}))
    queue.submit("cursed")
    for _ in range(MOST_RENEWALS):
        queue.cancel(["cursed"])
        assert reconcile_once(database, queue, renewals=renewals) == 1
        assert jobs.get("cursed").state == JobState.queued
    queue.cancel(["cursed"])
    assert reconcile_once(database, queue, renewals=renewals) == 1
    job = jobs.get("cursed")
    assert (job.state, (job.error or NO_ERROR).code) == ("failed", "engine")
    assert reconcile_once(database, queue, renewals=renewals) == 0


def test_a_lost_submission_is_seen_behind_any_number_of_older_jobs(
    database: Database, queue: JobQueue
) -> None:
    """1,003 older jobs wait; one that is to be cancelled lies between them and the lost one."""
    jobs, runs = Jobs(database), Runs(database)
    jobs.create(NewJob(id="older-0000", kind="toy", request={}))
    with database.write() as session:
        row = session.get_one(JobRow, "older-0000")
        values = {column.name: getattr(row, column.name) for column in JobRow.__table__.columns}
        # all of one moment: the pages go on by id within it
        older = [values | {"id": f"older-{index:04}"} for index in range(1, 1003)]
        session.execute(sa.insert(JobRow), older)
    for name in ("unwanted", "lost"):
        jobs.create(NewJob(id=name, kind="toy", request={}))
    runs.start("unwanted")
    jobs.request_cancel("unwanted")
    pages = list(runs.unfinished())
    assert [len(page) for page in pages] == [1, 1000, 4]
    names = [job.job_id for page in pages for job in page]
    assert names == ["unwanted", *(f"older-{index:04}" for index in range(1003)), "lost"]

    class Sent(JobQueue):
        """All older ones are known to the engine."""

        def __init__(self) -> None:
            self.sent: list[str] = []

        def statuses(self, workflow_ids: Sequence[str]) -> dict[str, str]:
            return {name: "ENQUEUED" for name in workflow_ids if name.startswith("older")}

        def submit(self, job_id: str, **_: object) -> None:
            self.sent.append(job_id)

        def cancel(self, workflow_ids: Collection[str]) -> None:
            assert list(workflow_ids) == ["unwanted"]

    sent = Sent()
    assert reconcile_once(database, sent) == 3
    assert sent.sent == ["unwanted", "lost"]
    assert jobs.get("unwanted").state == JobState.canceled


class Trap:
    """Makes a folder when a pickle of it is read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._folder),)


@pytest.mark.parametrize("column", ["output", "error"])
def test_a_pickle_in_the_database_is_not_read(
    queue: JobQueue, database_url: str, tmp_path: Path, column: str
) -> None:
    trap = tmp_path / "trap"
    text = base64.b64encode(pickle.dumps(Trap(trap))).decode()
    queue.submit("job")
    engine = sa.create_engine(normalise_url(engine_url(database_url)))
    schema = "dbos." if engine.dialect.name == "postgresql" else ""
    with engine.begin() as connection:
        ended = f"UPDATE {schema}workflow_status SET serialization = 'py_pickle', status = 'ERROR'"
        connection.execute(sa.text(ended))
        put = f"INSERT INTO {schema}workflow_output (workflow_uuid, {column}) VALUES ('job', :text)"
        connection.execute(sa.text(put), {"text": text})
    engine.dispose()
    assert queue.output("job") == text
    assert not trap.exists()
    pickle.loads(base64.b64decode(text))  # the trap itself is sound
    assert trap.exists()


def test_one_module_knows_the_engine() -> None:
    package = Path(prtbake_storage.__file__).parent
    knowing = [
        path
        for path in package.rglob("*.py")
        if re.search(r"^\s*(from|import) dbos\b", path.read_text(), re.M)
    ]
    assert knowing == [package / "queue" / "engine.py"]


def test_what_the_engine_calls_giving_up_is_said_once() -> None:
    package = Path(prtbake_storage.__file__).parent
    text = {path: path.read_text() for path in package.rglob("*.py")}
    for words in (f'"{GIVEN_UP}"', '"poison-task"'):
        assert [path for path in text if words in text[path]] == [package / "queue" / "engine.py"]

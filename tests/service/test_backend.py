"""What a service process opens."""

import sqlite3
import time
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from prtbake_service.backend import Backend
from prtbake_service.health.metrics import Metrics
from prtbake_service.testing import live_service, quick_settings
from prtbake_storage.queue.engine import JobQueue, engine_url
from prtbake_storage.queue.reconcile import Reconciler
from prtbake_storage.records import Jobs, NewJob, create_database

YEAR_S = 365 * 86400.0


def test_each_process_leaves_its_unfinished_files_under_a_name_of_its_own(tmp_path: Path) -> None:
    settings = quick_settings(tmp_path)
    owners = set()
    for _ in range(2):
        backend = Backend.open(settings, Metrics())
        with backend.blobs.scratch() as folder:
            owners.add(folder.parent.name)
        backend.close()
    assert len(owners) == 2
    assert all(owner.startswith("service-") for owner in owners)


def leave_an_old_workflow(database_url: str) -> None:
    """Leave a workflow that ended a year ago, and a submission for a reconciler to make up for."""
    queue = JobQueue(database_url)
    queue.submit("old")
    queue.cancel(["old"])
    queue.close()
    with closing(
        sqlite3.connect(engine_url(database_url).removeprefix("sqlite:///"))
    ) as connection:
        ended_ms = int((time.time() - YEAR_S) * 1000)
        connection.execute("UPDATE workflow_status SET completed_at = ?", (ended_ms,))
        connection.commit()
    database = create_database(database_url)
    Jobs(database).create(NewJob(id="lost", kind="toy", request={}))
    database.dispose()


def await_rounds(queue: JobQueue) -> dict[str, str]:
    """Wait until a reconciler has been through two rounds; returns what it left."""
    deadline = time.monotonic() + 20.0
    for _ in range(2):
        while "lost" not in queue.statuses(["lost"]):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        left = queue.statuses(["old", "lost"])
        queue.forget("lost")  # it is submitted anew in the next round, after the first has pruned
    return left


def test_a_service_deletes_no_workflow_that_the_workers_are_to_keep(tmp_path: Path) -> None:
    settings = quick_settings(tmp_path, reconcile_every=timedelta(milliseconds=50))
    leave_an_old_workflow(settings.database)
    with live_service(settings) as live:
        assert "old" in await_rounds(live.backend.queue)


@pytest.mark.parametrize(("retention_s", "stays"), [(2 * YEAR_S, True), (YEAR_S / 2, False)])
def test_a_worker_keeps_workflows_for_as_long_as_it_is_told(
    tmp_path: Path, retention_s: float, *, stays: bool
) -> None:
    url = quick_settings(tmp_path).database
    leave_an_old_workflow(url)
    database, queue = create_database(url), JobQueue(url)
    reconciler = Reconciler(database, queue, every_s=0.05, retention_s=retention_s).start()
    assert ("old" in await_rounds(queue)) == stays
    reconciler.stop()
    queue.close()
    database.dispose()

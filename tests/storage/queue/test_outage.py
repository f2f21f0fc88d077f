"""A walk through a job whose database goes away under each of its words to the engine."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.queue.engine import JobQueue, task_id
from prtbake_storage.queue.parent import JobRun
from prtbake_storage.queue.patience import patiently
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_storage.queue.tasks import Services
from prtbake_storage.records import Jobs, NewJob, create_database
from prtbake_storage.testing.postgres import Server, private_server

pytestmark = pytest.mark.own_postgres

OUTAGE_S = 0.2
TASKS = [Task("no_module:no_function", {"index": index}) for index in range(2)]


class Interrupted(JobQueue):
    """Meets an outage at the first call of each kind."""

    def __init__(self, server: Server) -> None:
        super().__init__(server.url)
        self._server = server
        self.met: list[str] = []

    def __getattribute__(self, name: str) -> Any:
        if name in ("submit_task", "statuses", "output", "open_tasks", "cancel"):
            self._meet(name)
        return super().__getattribute__(name)

    def _meet(self, name: str) -> None:
        if name in self.met:
            return
        self.met.append(name)
        self._server.stop()
        threading.Timer(OUTAGE_S, self._server.start).start()


class TwoTasks:
    """One kind of two tasks, which nobody runs here."""

    def stages(self, _kind: str, _request: dict[str, Any], _context: dict[str, Any]) -> list[Stage]:
        return [Stage("tiles", "tiles", 1.0, lambda _results: TASKS)]

    def finish(
        self, _kind: str, _request: dict[str, Any], _context: dict[str, Any], _results: Results
    ) -> Finished:
        raise AssertionError("nothing was run")


@pytest.fixture
def server() -> Iterator[Server]:
    with private_server() as server:
        yield server


def test_no_word_to_the_engine_is_lost_in_an_outage(server: Server, tmp_path: Path) -> None:
    database = create_database(server.url)
    queue, other, shutdown = Interrupted(server), JobQueue(server.url), threading.Event()
    settings = QueueSettings(poll_s=0.05)
    services = Services(database, LocalBlobStore(tmp_path), settings, shutdown, "no_module")
    Jobs(database).create(NewJob(id="job", kind="toy", request={}))
    walk = threading.Thread(
        target=JobRun(services, queue, TwoTasks(), "job", quick=False).run, daemon=True
    )
    walk.start()
    second = task_id("job", 0, 1, TASKS[1].key)
    while walk.is_alive() and not patiently(shutdown, other.statuses, [second]):
        time.sleep(0.05)
    # it ends without having been run: an error that the walk must find
    patiently(shutdown, other.cancel, [second])
    walk.join(timeout=30.0)
    assert not walk.is_alive()
    job = Jobs(database).get("job")
    assert job.state == JobState.failed
    assert job.error is not None
    assert (job.error.code, job.error.detail) == ("engine", "a task ended as CANCELLED: None")
    assert queue.met == ["submit_task", "statuses", "output", "open_tasks", "cancel"]
    assert other.open_tasks("job") == {}
    other.close()
    queue.close()
    database.dispose()

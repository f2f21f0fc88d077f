"""A task's run on a worker whose blob store has its bad moments."""

import errno
import logging
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.queue.memo import recall
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import Task
from prtbake_storage.queue.tasks import Outcome, Services, TaskRun
from prtbake_storage.records import Events, Jobs, NewJob, Runs, create_database
from prtbake_storage.testing.blob_contract import digest_of

TASK = Task("child_tasks:store_text", {"text": "red"}, label="red")
CALLS = {"get_result": "recalling red", "put_result": "remembering red", "scratch": "running red"}
"""What a task's run asks of the store, and what it is for."""


class FailingStore(LocalBlobStore):
    """A real store whose call ``method`` fails ``times`` times with ``number``."""

    def __init__(self, root: Path, method: str, times: int, number: int = errno.EIO) -> None:
        super().__init__(root)
        self.left = times
        works = getattr(self, method)

        def call(*args: Any, **kwargs: Any) -> Any:
            if self.left > 0:
                self.left -= 1
                raise OSError(number, os.strerror(number), str(root))
            return works(*args, **kwargs)

        setattr(self, method, call)


@pytest.fixture
def services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    settings = QueueSettings(data_dir=tmp_path, retry_wait_s=0.01)
    database = create_database(settings.database_url)
    Jobs(database).create(NewJob(id="job", kind="words", request={}))
    Runs(database).start("job")
    store = LocalBlobStore(tmp_path / "blobs")
    yield Services(database, store, settings, threading.Event(), "child_tasks")
    database.dispose()


def run(services: Services, store: LocalBlobStore | None = None) -> Outcome:
    if store is not None:
        services = replace(services, store=store)
    return TaskRun(services, "job", 0, 0, TASK).run()


def log_of(services: Services) -> list[str]:
    events = Events(services.database).after("job")
    return [event.data["message"] for event in events if event.type == "log"]


@pytest.mark.parametrize("method", CALLS)
def test_a_store_that_fails_in_passing_is_asked_again(
    services: Services, method: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    store = FailingStore(services.store.root, method, 2)
    assert run(services, store) == Outcome("done", key=TASK.key)
    memory = recall(services.store, TASK.key)
    assert memory is not None
    assert memory.result == {"digest": digest_of(b"red")}
    # hours of work are not done again because its result could not be written at once
    assert [record.message for record in caplog.records].count("task.done") == 1
    assert len(log_of(services)) == 2
    assert all("retrying after: OSError: [Errno 5]" in line for line in log_of(services))


def test_what_was_made_before_says_so(services: Services) -> None:
    ran, found = run(services), run(services)
    assert (ran.recalled, found.recalled) == (False, True)
    assert Outcome.from_dict(found.to_dict()) == found
    # a worker of an earlier version does not tell
    assert Outcome.from_dict({"status": "done", "error": None, "key": TASK.key}) == ran


@pytest.mark.parametrize("method", CALLS)
def test_a_store_that_stays_away_fails_the_task_by_what_was_tried(
    services: Services, method: str
) -> None:
    store = FailingStore(services.store.root, method, 3)
    outcome = run(services, store)
    assert outcome.status == "failed"
    assert outcome.error is not None
    assert (outcome.error.kind, outcome.error.code) == ("resource", "io-error")
    assert outcome.error.detail.startswith(f"{CALLS[method]}, tried 3 times: OSError: [Errno 5]")
    assert str(store.root) in outcome.error.detail
    assert store.left == 0


@pytest.mark.parametrize(
    ("number", "code"), [(errno.ENOSPC, "disk-full"), (errno.EACCES, "internal")]
)
def test_an_error_that_will_not_pass_is_told_at_once(
    services: Services, number: int, code: str
) -> None:
    store = FailingStore(services.store.root, "put_result", 3, number)
    outcome = run(services, store)
    assert outcome.error is not None
    assert outcome.error.code == code
    assert store.left == 2
    assert log_of(services) == []


def test_a_wait_ends_when_the_job_is_cancelled(services: Services) -> None:
    patient = services.settings.model_copy(update={"retry_wait_s": 60.0})
    store = FailingStore(services.store.root, "get_result", 1)
    outcomes: list[Outcome] = []
    waiting = replace(services, store=store, settings=patient)
    thread = threading.Thread(
        target=lambda: outcomes.append(TaskRun(waiting, "job", 0, 0, TASK).run())
    )
    thread.start()
    deadline = time.monotonic() + 20.0
    while not log_of(services) and time.monotonic() < deadline:
        time.sleep(0.01)
    Jobs(services.database).request_cancel("job")
    thread.join(timeout=20.0)
    assert outcomes == [Outcome("stopped")]

"""What the garbage collector leaves and takes, with jobs in every state."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from child_tasks import TWO_STAGES

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.contract.jobs import JobState, Progress
from prtbake_storage.queue.garbage import Collector
from prtbake_storage.queue.memo import Memory, enter, recall, remember
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import Measured, Results
from prtbake_storage.records import (
    Database,
    Jobs,
    NewArtefact,
    NewJob,
    Runs,
    Stop,
)

MONTH_S = 30 * 86400.0


@pytest.fixture
def store(tmp_path: Path) -> LocalBlobStore:
    return LocalBlobStore(tmp_path / "store")


@pytest.fixture
def collector(database: Database, store: LocalBlobStore) -> Collector:
    return Collector(database, store, TWO_STAGES, QueueSettings(garbage_every_s=0.05))


def age(store: LocalBlobStore) -> None:
    """Make everything in the store a month old."""
    for path in store.root.rglob("*"):
        if path.is_file():
            os.utime(path, (time.time() - MONTH_S,) * 2)


def begin(database: Database, job_id: str, *words: str) -> None:
    """Submit a job and mark it running."""
    Jobs(database).create(NewJob(id=job_id, kind="words", request={"words": list(words)}))
    Runs(database).start(job_id)


def work(store: LocalBlobStore, words: list[str], *, stages: int = 2) -> list[Memory]:
    """Do and remember the tasks of so many stages of a job, as workers would."""
    results, done = Results(), []
    for stage in TWO_STAGES.stages("words", {"words": words}, {})[:stages]:
        memories = []
        for task in stage.tasks(results):
            result = {"digest": store.put_bytes(task.args["text"].encode())}
            memories.append(remember(store, task.key, Memory(result, Measured(1.0, 1))))
        enter(results, stage, memories)
        done += memories
    return done


def digests(memories: list[Memory]) -> list[str]:
    return sorted(memory.result["digest"] for memory in memories)


def stored(store: LocalBlobStore) -> list[str]:
    return [blob.digest for blob in store.blobs()]


def succeed(database: Database, job_id: str, digest: str) -> None:
    artefact = NewArtefact("joined.txt", "text/plain", digest, 1)
    assert Runs(database).succeed(job_id, result={}, artefacts=[artefact], progress=Progress())


def test_a_running_job_keeps_the_results_it_stands_on(
    database: Database, store: LocalBlobStore, collector: Collector
) -> None:
    begin(database, "job", "red", "green")
    memories = work(store, ["red", "green"])
    work(store, ["blue"], stages=1)  # nobody's any more
    age(store)
    report = collector.collect()
    assert (report.n_results, report.n_blobs) == (1, 1)
    assert stored(store) == digests(memories)
    # once it has succeeded only its file is in use
    succeed(database, "job", memories[-1].result["digest"])
    report = collector.collect()
    assert (report.n_results, report.n_blobs) == (3, 2)
    assert stored(store) == [memories[-1].result["digest"]]
    # and once it is deleted, nothing
    Jobs(database).delete("job")
    assert collector.collect().n_blobs == 1
    assert stored(store) == []


def test_a_job_in_its_first_stage_keeps_what_is_done(
    database: Database, store: LocalBlobStore, collector: Collector
) -> None:
    (memory,) = work(store, ["red"], stages=1)
    age(store)
    begin(database, "job", "red", "green", "blue")
    assert collector.collect().n_results == 0
    assert stored(store) == [memory.result["digest"]]


def test_a_deleted_jobs_file_stays_for_the_job_that_recalled_it(
    database: Database, store: LocalBlobStore, collector: Collector
) -> None:
    begin(database, "first", "red")
    memories = work(store, ["red"])
    succeed(database, "first", memories[-1].result["digest"])
    begin(database, "second", "red")  # all of it is remembered
    Jobs(database).delete("first")
    age(store)
    assert collector.collect().n_blobs == 0
    assert stored(store) == digests(memories)
    assert Runs(database).close("second", Stop(JobState.expired))
    assert collector.collect().n_blobs == 2


def test_what_is_recalled_is_young_again(store: LocalBlobStore, collector: Collector) -> None:
    red, _ = work(store, ["red"]), work(store, ["green"])
    age(store)
    stages = TWO_STAGES.stages("words", {"words": ["red"]}, {})
    (task,) = stages[0].tasks(Results())
    assert recall(store, task.key) == red[0]
    report = collector.collect()
    assert (report.n_results, report.n_blobs) == (3, 3)
    assert stored(store) == [red[0].result["digest"]]
    assert recall(store, task.key) == red[0]


def test_a_job_that_cannot_be_planned_does_not_stop_the_collector(
    database: Database, store: LocalBlobStore, collector: Collector
) -> None:
    mesh = store.put_bytes(b"a mesh")
    store.put_bytes(b"garbage")
    age(store)
    Jobs(database).create(NewJob(id="odd", kind="odd", request={}, context={"mesh": mesh}))
    assert collector.collect().n_blobs == 1
    assert stored(store) == [mesh]


def test_the_collector_goes_on_after_an_error(
    store: LocalBlobStore, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds: list[str] = []
    blobs = store.blobs

    def away_at_first() -> Any:
        rounds.append("round")
        if len(rounds) == 1:
            raise OSError(5, "Input/output error")
        return blobs()

    monkeypatch.setattr(store, "blobs", away_at_first)
    store.put_bytes(b"garbage")
    age(store)
    stop = threading.Event()
    thread = threading.Thread(target=collector.run, args=(stop,))
    thread.start()
    deadline = time.monotonic() + 20.0
    while list(blobs()) and time.monotonic() < deadline:
        time.sleep(0.01)
    stop.set()
    thread.join()
    assert list(blobs()) == []
    assert len(rounds) >= 2


def test_an_operator_sees_what_would_go_and_then_lets_it_go(
    tmp_path: Path, store: LocalBlobStore
) -> None:
    work(store, ["red"])
    age(store)
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        "PRTBAKE_DATABASE_URL": f"sqlite:///{tmp_path / 'prtbake.sqlite'}",
        "PRTBAKE_BLOB_URL": store.url,
    }
    program = (
        "from prtbake_storage.queue.garbage_main import main\n"
        "for more in ['--dry-run'], []: main(['--registry', 'child_tasks:TWO_STAGES', *more])\n"
    )
    output = subprocess.check_output([sys.executable, "-c", program], env=environment)
    said = [json.loads(line) for line in output.splitlines()]
    went = {"n_blobs": 2, "n_bytes": 3 + 71, "n_results": 2}
    assert said[0] == went | {"dry_run": True}
    assert said[1] == went | {"dry_run": False}
    assert stored(store) == []


def test_the_grace_time_cannot_be_shorter_than_a_long_task() -> None:
    with pytest.raises(ValueError, match="garbage_grace_s"):
        QueueSettings(garbage_grace_s=60.0)

"""A job's walk through its stages, on real tasks; only the engine between them is played."""

import errno
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

sys.path.insert(0, str(Path(__file__).parent))

from child_tasks import TWO_STAGES

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.contract.jobs import Job, JobState
from prtbake_storage.queue import parent, patience, stages
from prtbake_storage.queue.engine import GIVEN_UP, task_id
from prtbake_storage.queue.memo import finished_tasks, recall
from prtbake_storage.queue.parent import JobRun
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import Results, Task, package_of
from prtbake_storage.queue.tasks import Outcome, Services, TaskRun
from prtbake_storage.records import Database, Events, Jobs, NewJob, create_database
from prtbake_storage.testing.blob_contract import digest_of


@pytest.fixture
def services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    settings = QueueSettings(data_dir=tmp_path, poll_s=0.01, retry_wait_s=0.01)
    database = create_database(settings.database_url)
    store = LocalBlobStore(tmp_path / "blobs")
    yield Services(database, store, settings, threading.Event(), package_of(TWO_STAGES))
    database.dispose()


class Queue:
    """Stands for the engine and a worker: a task runs when it is queued, once for each name."""

    def __init__(self, services: Services) -> None:
        self.services = services
        self.outputs: dict[str, dict[str, Any]] = {}
        self.n_runs = 0

    def submit_task(
        self, job_id: str, stage: int, position: int, task: dict[str, Any], *, key: str,
        priority: int,
    ) -> str:  # fmt: skip
        assert priority == 50
        name = task_id(job_id, stage, position, key)
        if name not in self.outputs:
            self.n_runs += 1
            run = TaskRun(self.services, job_id, stage, position, Task.from_dict(task))
            self.outputs[name] = run.run().to_dict()
        return name

    def statuses(self, names: Sequence[str]) -> dict[str, str]:
        return {name: "SUCCESS" for name in names if name in self.outputs}

    def output(self, name: str) -> dict[str, Any]:
        return self.outputs[name]

    def forget(self, name: str) -> None:
        del self.outputs[name]

    def open_tasks(self, _job_id: str) -> dict[str, str]:
        return {}


@pytest.fixture
def queue(services: Services) -> Queue:
    return Queue(services)


def submitted(database: Database, *words: str) -> None:
    Jobs(database).create(NewJob(id="job", kind="words", request={"words": list(words)}))


def walk(services: Services, queue: Queue, *, quick: bool = False) -> Job:
    """Run the job to its end, as a worker would."""
    JobRun(services, queue, TWO_STAGES, "job", quick=quick).run()  # type: ignore[arg-type]
    return Jobs(services.database).get("job")


def test_a_stage_repeats_until_it_has_no_tasks(services: Services, queue: Queue) -> None:
    request = {"words": ["red", "green", "blue"]}
    Jobs(services.database).create(NewJob(id="job", kind="chain", request=request))
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    # three rounds of two, each named by the one before, and the stage that follows
    assert queue.n_runs == 7
    digests: list[str] = []
    for word in request["words"]:
        digests = [digest_of(f"{' '.join(digests)} {word} {n}".encode()) for n in range(2)]
    (artefact,) = job.artefacts
    assert services.store.read_bytes(artefact.sha256).decode() == " ".join(digests)
    events = Events(services.database).after("job")
    told = [event.data for event in events if event.type == "progress"]
    fractions = [one["fraction"] for one in told]
    assert fractions == sorted(fractions)
    # of five rounds that there could have been
    seen = {(one["done"], one["total"]) for one in told if one["unit"] == "rounds"}
    assert seen == {(0, 5), (1, 5), (2, 5)}
    # whoever walks again finds every round
    stages = TWO_STAGES.stages("chain", request, {})
    assert len(list(finished_tasks(services.store, stages))) == 7
    services.store.delete_result(list(finished_tasks(services.store, stages))[3])
    assert len(list(finished_tasks(services.store, stages))) == 3


def first_task(*words: str) -> Task:
    (task, *_) = TWO_STAGES.stages("words", {"words": list(words)}, {})[0].tasks(Results())
    return task


def test_a_job_runs_its_stages_and_ends_well(services: Services, queue: Queue) -> None:
    submitted(services.database, "red", "green")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    assert queue.n_runs == 3
    (artefact,) = job.artefacts
    digests = [digest_of(word) for word in (b"red", b"green")]
    assert services.store.read_bytes(artefact.sha256).decode() == " ".join(digests)


def test_a_job_taken_up_after_an_upgrade_does_not_wait_for_the_old_code(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitted(services.database, "red")
    task = first_task("red")
    old = queue.submit_task("job", 0, 0, task.to_dict(), key=task.key, priority=50)
    assert queue.outputs[old]["status"] == "done"
    monkeypatch.setattr(stages, "code_version", lambda: "new")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    assert queue.n_runs == 3  # the old code's, and both stages by the new


def test_a_parent_takes_what_a_worker_with_other_code_has_made(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = queue.submit_task

    def submit_elsewhere(*args: Any, **fields: Any) -> str:
        with monkeypatch.context() as patch:
            patch.setattr(stages, "code_version", lambda: "theirs")
            return submit(*args, **fields)

    monkeypatch.setattr(queue, "submit_task", submit_elsewhere)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    # and nobody takes it later for what this code makes
    assert recall(services.store, first_task("red").key) is None


@pytest.mark.parametrize("quick", [False, True])
def test_a_task_whose_result_is_gone_is_run_again(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch, quick: bool
) -> None:
    ran = TaskRun.run
    n_lost = 0

    def lose_the_first(run: TaskRun) -> Outcome:
        nonlocal n_lost
        outcome = ran(run)
        if n_lost == 0:
            n_lost += services.store.delete(digest_of(b"red"))
        return outcome

    monkeypatch.setattr(TaskRun, "run", lose_the_first)
    submitted(services.database, "red")
    job = walk(services, queue, quick=quick)
    assert n_lost == 1
    assert job.state == JobState.succeeded, job.error
    assert services.store.read_bytes(digest_of(b"red")) == b"red"


def test_a_result_that_never_stays_fails_the_job(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = queue.output

    def lose(name: str) -> dict[str, Any]:
        services.store.delete(digest_of(b"red"))
        return output(name)

    monkeypatch.setattr(queue, "output", lose)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.state == JobState.failed
    assert job.error is not None
    assert (job.error.code, queue.n_runs) == ("lost-result", 3)
    assert job.error.detail == "the result of child_tasks:store_text was made and lost 3 times"


@pytest.mark.parametrize("call", ["get_result", "size"])
def test_a_store_that_fails_in_passing_does_not_fail_the_job(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    works, calls = getattr(services.store, call), []

    def fail_twice(name: str) -> Any:
        calls.append(name)
        if len(calls) <= 2:
            raise OSError(errno.ESTALE, "Stale file handle", name)
        return works(name)

    monkeypatch.setattr(services.store, call, fail_twice)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    events = Events(services.database).after("job")
    told = [event.data["message"] for event in events if event.type == "log"]
    assert len(told) == 2
    assert all("Stale file handle" in line for line in told)


def test_a_store_that_stays_away_fails_the_job_by_what_was_tried(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(digest: str) -> int:
        raise OSError(errno.EIO, "Input/output error", digest)

    monkeypatch.setattr(services.store, "size", fail)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.error is not None
    assert (job.state, job.error.code) == (JobState.failed, "io-error")
    assert job.error.detail.startswith("measuring joined.txt, tried 3 times: OSError: [Errno 5]")


@pytest.mark.parametrize("call", ["submit_task", "statuses", "output"])
def test_an_engine_whose_database_is_away_is_waited_for(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    monkeypatch.setattr(patience, "RETRY_S", 0.01)
    works, calls = getattr(queue, call), []

    def fail_often(*args: Any, **fields: Any) -> Any:
        calls.append(call)
        if len(calls) <= 5:
            raise OperationalError("SELECT 1", {}, Exception("disk I/O error"))
        return works(*args, **fields)

    monkeypatch.setattr(queue, call, fail_often)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error


def test_a_task_that_too_many_workers_were_lost_with_fails_the_job(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queue, "statuses", lambda names: dict.fromkeys(names, GIVEN_UP))
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.error is not None
    assert (job.state, job.error.kind, job.error.code) == ("failed", "resource", "poison-task")
    lost = services.settings.worker_losses
    assert job.error.detail.startswith(f"{lost} workers were lost while they ran this task")


def test_a_result_that_another_job_made_in_the_meantime_is_recalled(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What its making took is another job's: nothing is learnt of it."""
    found: dict[str, bool] = {}
    finish = TWO_STAGES.finish

    def spy(kind: str, request: Any, context: Any, results: Results) -> Any:
        found.update({stage: results.recalled(stage) for stage in results})
        return finish(kind, request, context, results)

    submit = queue.submit_task

    def made_elsewhere(*args: Any, **fields: Any) -> str:
        if "other" not in found:  # between the list of this stage and the run of its first task
            found["other"] = True
            TaskRun(services, "job", 0, 0, first_task("red")).run()
        return submit(*args, **fields)

    monkeypatch.setattr(TWO_STAGES, "finish", spy)
    monkeypatch.setattr(queue, "submit_task", made_elsewhere)
    submitted(services.database, "red")
    job = walk(services, queue)
    assert job.state == JobState.succeeded, job.error
    first, last = list(found)[1:]
    assert (found[first], found[last]) == (True, False)


def test_a_job_of_many_tasks_looks_for_a_cancel_while_it_recalls_them(
    services: Services, queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def slow(store: Any, key: str) -> None:
        asked.append(key)
        if len(asked) == 3:
            Jobs(services.database).request_cancel("job")

    monkeypatch.setattr(parent, "recall", slow)
    monkeypatch.setattr(parent, "PROGRESS_EVERY_S", 0.0)
    submitted(services.database, *(f"word {index}" for index in range(40)))
    job = walk(services, queue)
    assert job.state == JobState.canceled
    assert (len(asked), queue.n_runs) == (3, 0)

"""The engine under every kind of death, with real processes, on both databases."""

import base64
import hashlib
import os
import pickle
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fleet import Fleet, is_alive

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.queue.engine import engine_url
from prtbake_storage.queue.reconcile import reconcile_once
from prtbake_storage.queue.tasks import Outcome
from prtbake_storage.records import Events, NewJob
from prtbake_storage.testing.postgres import fresh_database

pytestmark = pytest.mark.acceptance

EMBEDDED = pytest.mark.parametrize("new_fleet", ["sqlite"], indirect=True)
"""For what the database has no part in: once is enough."""
DATABASES = ["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)]


def expected_digest(seed: int, n: int) -> str:
    """Digest of the joined tiles, computed without the engine."""
    blocks = [hashlib.sha256(f"{seed}-{index}".encode()).digest() * 2048 for index in range(n)]
    return f"sha256:{hashlib.sha256(b''.join(blocks)).hexdigest()}"


@pytest.fixture(scope="module", params=DATABASES)
def new_fleet(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Fleet]:
    """A fleet without workers."""
    folder = tmp_path_factory.mktemp("fleet")
    with ExitStack() as stack:
        url = f"sqlite:///{folder / 'prtbake.sqlite'}"
        if request.param == "postgresql":
            url = stack.enter_context(fresh_database(request.getfixturevalue("postgres_url")))
        fleet = Fleet(folder, url)
        yield fleet
        fleet.close()


@pytest.fixture(scope="module")
def fleet(new_fleet: Fleet) -> Fleet:
    """Two supervised workers with a tile slot each; tests leave two behind."""
    new_fleet.supervise(2)
    return new_fleet


@pytest.fixture
def lone(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Fleet]:
    """A SQLite fleet of one's own."""
    fleet = Fleet(tmp_path, f"sqlite:///{tmp_path / 'prtbake.sqlite'}")
    yield fleet
    fleet.close()


def change_workflows(fleet: Fleet, statement: str, *values: str) -> None:
    """Change the one workflow of a SQLite fleet behind the engine's back."""
    path = engine_url(fleet.settings.database_url).removeprefix("sqlite:///")
    with closing(sqlite3.connect(path)) as connection, connection:
        assert connection.execute(statement, values).rowcount == 1


class Trap:
    """Makes a folder when a pickle of it is read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._folder),)


def test_a_job_runs_in_tiles_on_both_workers(fleet: Fleet) -> None:
    job = fleet.ended(fleet.submit(n=4, seconds=0.5, seed=1))
    assert (job.state, job.result) == ("succeeded", {"n_tiles": 4, "timed": True})
    (artefact,) = job.artefacts
    assert (artefact.name, artefact.sha256) == ("joined.bin", expected_digest(1, 4))
    assert artefact.size == 4 * 65536
    assert len({note.worker for note in fleet.noted("started", "1-")}) == 2
    events = Events(fleet.database).after(job.id)
    assert [e.data["state"] for e in events if e.type == "state"] == [
        "queued",
        "running",
        "succeeded",
    ]
    assert sum(e.type == "log" for e in events) == 4
    fractions = [e.data["fraction"] for e in events if e.type == "progress"]
    assert fractions == sorted(fractions)
    assert job.progress.fraction == 1.0


def test_kill_9_of_a_worker_costs_only_its_own_tile(fleet: Fleet) -> None:
    job_id = fleet.submit(n=6, seconds=0.8, seed=2)
    fleet.await_note("finished", "2-", 2)
    finished = set(fleet.counts("finished", "2-"))
    victim = fleet.await_running("2-")
    os.kill(victim.worker, signal.SIGKILL)
    # its child dies with it, although nobody killed the child
    fleet.until(lambda: not is_alive(victim.pid), "the orphan's death", 5.0)
    job = fleet.ended(job_id)
    assert job.state == "succeeded"
    assert job.artefacts[0].sha256 == expected_digest(2, 6)
    started = fleet.counts("started", "2-")
    assert all(started[name] == 1 for name in finished)
    assert started[victim.name] == 2
    assert set(started) == {f"2-{index}" for index in range(6)}
    fleet.await_workers(2)
    fleet.until(lambda: not fleet.leftovers(), "scratch to be swept", 20.0)


def test_cancel_frees_the_cpu_and_leaves_nothing(fleet: Fleet) -> None:
    job_id = fleet.submit(n=40, seconds=30.0, seed=3, burn=True)
    fleet.await_note("started", "3-", 2)
    fleet.until(lambda: len(fleet.leftovers()) >= 2, "files in scratch")
    assert len(fleet.running("3-")) == 2
    asked = time.monotonic()
    assert fleet.jobs.request_cancel(job_id).state == JobState.cancel_requested
    fleet.until(lambda: not fleet.running("3-"), "the tasks' death")
    assert time.monotonic() - asked < 2.0
    job = fleet.ended(job_id)
    assert (job.state, job.artefacts, job.result) == ("canceled", [], None)
    assert fleet.leftovers() == []
    assert fleet.queue.open_tasks(job_id) == {}
    assert len(fleet.noted("started", "3-")) == 2
    assert fleet.jobs.request_cancel(job_id).state == "canceled"


@EMBEDDED
def test_a_queued_job_is_cancelled_at_once_and_never_starts(fleet: Fleet) -> None:
    blocker = fleet.submit(n=2, seconds=30.0, seed=4)
    fleet.await_note("started", "4-", 2)
    job_id = fleet.submit(n=1, seconds=0.1, seed=5)
    fleet.jobs.request_cancel(job_id)
    fleet.jobs.request_cancel(blocker)
    assert fleet.ended(job_id).state == "canceled"
    fleet.ended(blocker)
    assert fleet.noted("started", "5-") == []


def test_a_submission_killed_between_its_commits_still_runs_once(fleet: Fleet) -> None:
    code = (
        "import os, sys; from prtbake_storage.records import *\n"
        "request = {'n': 3, 'seconds': 0.1, 'seed': 6}\n"
        "Jobs(create_database(sys.argv[1])).create("
        "NewJob(id='half-submitted', kind='tiles', request=request))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    url = fleet.settings.database_url
    assert subprocess.run([sys.executable, "-c", code, url], check=False).returncode == -9
    assert fleet.ended("half-submitted").state == "succeeded"
    assert set(fleet.counts("started", "6-").values()) == {1}
    states = [
        e.data["state"] for e in Events(fleet.database).after("half-submitted") if e.type == "state"
    ]
    assert states == ["queued", "running", "succeeded"]


@EMBEDDED
def test_an_id_may_be_used_again_after_its_job_was_deleted(fleet: Fleet) -> None:
    job_id = fleet.submit(n=1, seconds=0.1, seed=7)
    fleet.ended(job_id)
    fleet.jobs.delete(job_id)  # and the workflow of that name has ended: SUCCESS
    request = {"n": 1, "seconds": 0.1, "seed": 7}
    fleet.jobs.create(NewJob(id=job_id, kind="tiles", request=request))
    job = fleet.ended(job_id)
    assert (job.state, job.artefacts[0].sha256) == ("succeeded", expected_digest(7, 1))


@EMBEDDED
@pytest.mark.parametrize(
    ("how", "code", "attempts"),
    [("dies", "task-died", 3), ("input", "invalid-settings", 1), ("nan", "internal", 1)],
)
def test_a_bad_task_fails_the_job_and_stops_the_others(
    fleet: Fleet, how: str, code: str, attempts: int
) -> None:
    before = len(fleet.noted("started", how))
    seed = f"bad-{how}-{fleet.settings.database_url[:6]}"
    job = fleet.ended(fleet.submit("poison", how=how, n=3, seconds=30.0, seed=seed))
    assert job.state == "failed"
    assert job.error is not None
    assert job.error.code == code
    assert job.error.pointer == ("/how" if how == "input" else None)
    assert len(fleet.noted("started", how)) - before == attempts
    assert fleet.running(seed) == []
    assert fleet.leftovers() == []
    assert job.artefacts == []


@EMBEDDED
def test_an_error_that_passes_is_tried_again(fleet: Fleet) -> None:
    job = fleet.ended(fleet.submit("poison", how="once", n=0, seconds=0.0, seed=8))
    assert job.state == "succeeded"
    assert len(fleet.noted("started", "once")) == 2
    logs = [e.data["message"] for e in Events(fleet.database).after(job.id) if e.type == "log"]
    assert logs == ["retrying after: not yet"]


def test_a_retry_reuses_the_finished_tiles(fleet: Fleet) -> None:
    first = fleet.submit(n=5, seconds=0.4, seed=9)
    fleet.await_note("finished", "9-", 2)
    fleet.jobs.request_cancel(first)
    fleet.ended(first)
    finished = set(fleet.counts("finished", "9-"))
    job = fleet.ended(fleet.submit(n=5, seconds=0.4, seed=9, retry_of=first))
    assert (job.state, job.retry_of) == ("succeeded", first)
    assert job.artefacts[0].sha256 == expected_digest(9, 5)
    started = fleet.counts("started", "9-")
    assert 2 <= len(finished) < 5
    assert all(started[name] == 1 for name in finished)
    assert fleet.jobs.get(first).artefacts == []


@EMBEDDED
def test_a_job_beyond_its_time_expires(fleet: Fleet) -> None:
    job = fleet.ended(fleet.submit(n=3, seconds=30.0, seed=10, timeout_s=1.0))
    assert (job.state, job.artefacts) == ("expired", [])
    assert job.started is not None
    assert job.finished is not None
    assert (job.finished - job.started).total_seconds() >= 1.0
    assert fleet.running("10-") == []
    assert fleet.leftovers() == []


@EMBEDDED
def test_a_quick_job_does_not_wait_for_long_tiles(fleet: Fleet) -> None:
    long = fleet.submit(n=4, seconds=30.0, seed=11)
    fleet.await_note("started", "11-", 2)
    job = fleet.ended(fleet.submit("quick", quick=True, seed=11))
    assert (job.state, job.result) == ("succeeded", {"parse": [{"how": "fine"}]})
    assert len(fleet.running("11-")) == 2
    fleet.jobs.request_cancel(long)
    fleet.ended(long)


def test_sigterm_hands_the_tile_over(fleet: Fleet) -> None:
    assert fleet.supervisor is not None
    job_id = fleet.submit(n=3, seconds=1.5, seed=12)
    fleet.await_note("started", "12-", 2)
    victim = fleet.await_running("12-")
    os.kill(victim.worker, signal.SIGTERM)
    fleet.until(lambda: not is_alive(victim.worker), "the worker's leave", 10.0)
    assert not is_alive(victim.pid)
    job = fleet.ended(job_id)
    assert (job.state, job.artefacts[0].sha256) == ("succeeded", expected_digest(12, 3))
    assert fleet.counts("started", "12-")[victim.name] == 2
    fleet.await_workers(2)


def test_a_task_that_kills_workers_is_given_up(fleet: Fleet) -> None:
    job = fleet.ended(fleet.submit("poison", how="kills-worker", n=0, seconds=0.0, seed=13))
    assert job.state == "failed"
    assert job.error is not None
    assert (job.error.kind, job.error.code) == ("resource", "poison-task")
    losses = {note.worker for note in fleet.noted("started", "kills-worker")}
    assert len(losses) == fleet.settings.worker_losses
    fleet.await_workers(2)


def test_workers_without_a_supervisor_find_each_other_out_by_silence(lone: Fleet) -> None:
    workers = {worker.pid: worker for worker in (lone.spawn(), lone.spawn())}
    lone.await_workers(2)
    # one freezes, is taken for dead, and wakes: its late result must not count
    job_id = lone.submit(n=3, seconds=3.0, seed=14)
    lone.await_note("started", "14-", 2)
    sleeper = lone.await_running("14-")
    lone.freeze(sleeper.worker)
    lone.await_note("started", sleeper.name, 2)  # by the other, once its own tile is done
    os.kill(sleeper.worker, signal.SIGCONT)
    job = lone.ended(job_id)
    assert (job.state, job.artefacts[0].sha256) == ("succeeded", expected_digest(14, 3))
    states = [e.data["state"] for e in Events(lone.database).after(job_id) if e.type == "state"]
    assert states == ["queued", "running", "succeeded"]
    assert workers[sleeper.worker].poll() is None
    # one is killed, and nobody says so
    lone.await_workers(2)
    job_id = lone.submit(n=4, seconds=1.0, seed=15)
    lone.await_note("started", "15-", 3)
    victim = lone.await_running("15-")
    finished = set(lone.counts("finished", "15-"))
    workers[victim.worker].kill()
    job = lone.ended(job_id)
    assert (job.state, job.artefacts[0].sha256) == ("succeeded", expected_digest(15, 4))
    started = lone.counts("started", "15-")
    assert all(started[name] == 1 for name in finished)
    assert started[victim.name] == 2
    lone.until(lambda: len(lone.workers.all()) == 1, "the lost worker to be forgotten")
    lone.until(lambda: not lone.leftovers(), "scratch to be swept")


def test_a_claim_of_a_worker_that_nobody_knows_is_handed_on(lone: Fleet) -> None:
    # what is left when a worker claims something, leaves and is forgotten
    job_id = lone.submit(n=1, seconds=0.1, seed=19)
    change_workflows(lone, "UPDATE workflow_status SET status = 'PENDING', executor_id = 'nobody'")
    lone.spawn()
    lone.await_workers(1)
    lone.until(lambda: lone.jobs.get(job_id).state.terminal, "the job's end", 20.0)
    assert lone.jobs.get(job_id).state == "succeeded"


def test_what_a_killed_upload_left_is_swept_while_workers_run(lone: Fleet) -> None:
    lone.spawn()
    lone.await_workers(1)
    scratch = lone.settings.data_dir / "blobs" / "scratch"
    (living,) = (worker.executor_id for worker in lone.workers.all())
    left, held, fresh = (
        scratch / owner / "file" for owner in ("service-gone", living, "service-lives")
    )
    for path in (left, held, fresh):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    long_ago = time.time() - 2 * 3600.0
    for path in (left, held):
        os.utime(path, (long_ago, long_ago))
    lone.until(lambda: not left.exists(), "the sweep", 20.0)
    assert not left.parent.exists()
    assert held.exists()  # its owner may be at it for days
    assert fresh.exists()


def test_a_pickle_in_place_of_a_jobs_arguments_is_not_read(lone: Fleet) -> None:
    trap = lone.settings.data_dir / "trap"
    text = base64.b64encode(pickle.dumps(Trap(trap))).decode()
    job_id = lone.submit(n=1, seconds=0.1, seed=18)
    change_workflows(lone, "UPDATE workflow_status SET serialization = 'py_pickle'")
    change_workflows(lone, "UPDATE workflow_input SET inputs = ?", text)
    lone.spawn()
    job = lone.ended(job_id)
    assert not trap.exists()
    # the row never ran, so the reconciler made its workflow anew, from our own record
    assert job.state == "succeeded"


def test_a_function_from_outside_the_job_kinds_is_not_run(lone: Fleet) -> None:
    trap = lone.settings.data_dir / "trap"
    code = f"__import__('os').mkdir({str(trap)!r})"
    task = {"function": "cProfile:run", "args": code}
    job_id = lone.submit(n=1, seconds=30.0, seed=20)
    workflow = lone.queue.submit_task(job_id, 0, 9, task, key="0" * 64, priority=1)
    lone.spawn()
    lone.until(lambda: isinstance(lone.queue.output(workflow), dict), "the task's end")
    outcome = Outcome.from_dict(lone.queue.output(workflow))
    assert outcome.error is not None
    assert "cProfile:run is no task" in outcome.error.detail
    assert not trap.exists()


def test_nothing_lives_on_after_the_supervisor_was_killed(lone: Fleet) -> None:
    command = [sys.executable, "-m", "prtbake_storage.queue.worker_main", "--workers", "1"]
    supervisor = subprocess.Popen(
        [*command, "--registry", "toy_registry:REGISTRY"],
        env={**os.environ, **lone.settings.to_env(), **lone.environment},
    )
    job_id = lone.submit(n=1, seconds=30.0, seed=17)
    (tile,) = lone.await_note("started", "17-")
    supervisor.kill()
    supervisor.wait()
    lone.until(lambda: not is_alive(tile.worker) and not is_alive(tile.pid), "their end", 15.0)
    # it left in good order, and its peers would look for what it may have claimed since
    assert [worker.state for worker in lone.workers.all()] == ["gone"]
    assert lone.queue.claims() == []
    assert lone.jobs.get(job_id).state == "running"
    lone.jobs.request_cancel(job_id)
    # nobody is left to act on it: whoever reconciles sees that, here the next service or worker
    assert reconcile_once(lone.database, lone.queue) == 1
    assert lone.jobs.get(job_id).state == "canceled"

"""The job engine: the only module that knows dbos.

dbos keeps workflows in a database and hands each to one worker.  We use it as a durable queue and
nothing more: no step of ours is recorded.  A parent finds its tasks by their workflow ids and their
results in the blob store, so that running it again from the top is always right, whatever happened
to its worker; and cancellation lives in our own ``jobs`` row, which running code can look at.
"""

import json
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from dbos import DBOS, DBOSClient, DBOSConfig, EnqueueOptions, Serializer
from dbos._serialization import DefaultSerializer

from prtbake_storage.contract.jobs import JobError
from prtbake_storage.records.database import normalise_url

APPLICATION = "prtbake"
APPLICATION_VERSION = "prtbake-1"
"""Part of every workflow: only workers of this version take it.  Raise it when the arguments of the
workflows change, after the queues were drained; dbos's default, a hash of the sources, would strand
every job at each edit."""

JOBS, TASKS, QUICK = "jobs", "tiles", "quick"
GIVEN_UP = "MAX_RECOVERY_ATTEMPTS_EXCEEDED"
"""Status of a workflow that was lost with too many workers: `poison` is the error of its end."""
ENDED = frozenset({"SUCCESS", "ERROR", "CANCELLED", GIVEN_UP})
PARENT_LOSSES = 100
"""Workers that may be lost under a parent: the poison limit belongs to its tasks."""


def poison(losses: str) -> JobError:
    """Say that what was lost with so many workers is not given to another one."""
    return JobError(kind="resource", code="poison-task", detail=f"{losses}: it is given up")


class _Json(Serializer):
    """JSON for arguments and results: dbos's default is pickle, which runs what it reads."""

    def serialize(self, data: Any) -> str:
        """Write; an exception, which dbos records as a workflow's end, as its text."""
        return json.dumps(data, default=repr)

    def deserialize(self, serialized_data: str) -> Any:
        """Read back."""
        return json.loads(serialized_data)

    def name(self) -> str:
        """Tell our rows from pickled ones."""
        return "prtbake_json"


def _refuse_pickle(_serializer: object, _data: str) -> Any:
    """Stand in for dbos's reading of pickles.

    A row says itself how it was written, and dbos believes it whatever serializer it was given: who
    may write to the database could run code in the workers and in the service.
    """
    raise ValueError("a pickle in the engine's tables: we write none, and read none")


DefaultSerializer.deserialize = _refuse_pickle  # type: ignore[assignment,method-assign]


class Claim(NamedTuple):
    """A workflow that a worker holds."""

    workflow_id: str
    queue: str
    executor_id: str


def engine_url(database_url: str) -> str:
    """Say where the engine keeps its tables: beside SQLite's file, or in the same PostgreSQL."""
    url = normalise_url(database_url)
    if url.get_backend_name() == "sqlite":
        # as SQLite names what belongs to a database; by any other path it is the same one
        return f"sqlite:///{os.path.realpath(url.database or '')}-engine"
    return url.set(drivername="postgresql").render_as_string(hide_password=False)


def prepare(database_url: str) -> str:
    """Create or migrate the engine's tables, whoever starts first, and return their URL."""
    url = engine_url(database_url)
    if url.startswith("sqlite"):
        # dbos leaves the rollback journal on, which is four times slower with several workers
        connection = sqlite3.connect(url.removeprefix("sqlite:///"), timeout=30.0)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.close()
    DBOS.migrate(url)  # it locks out other migrators itself, on both databases
    return url


def task_id(job_id: str, stage: int, position: int, key: str) -> str:
    """Name the workflow of a task; job ids hold no dot, so a job's tasks share a prefix.

    The beginning of the task's key makes it another workflow when the code has changed, so that a
    job taken up after an upgrade does not wait for what the old code has done.
    """
    return f"{job_id}.{stage}.{position}.{key[:12]}"


class JobQueue:
    """The queue from outside: submit jobs, look at workflows.

    Every call raises SQLAlchemy's error at once where the database is away; `patiently` waits.
    """

    def __init__(self, database_url: str) -> None:
        _hush()
        self._client = DBOSClient(
            system_database_url=prepare(database_url),
            application_name=APPLICATION,
            serializer=_Json(),
            # the caller decides how long to wait: dbos would for up to a minute, deaf to a SIGTERM
            retry_connection_errors=False,
        )

    def submit(self, job_id: str, *, quick: bool = False, priority: int = 50) -> None:
        """Queue a job whose row is committed; doing so again changes nothing."""
        name = QUICK if quick else JOBS
        self._enqueue(name, name, job_id, priority, job_id)

    def submit_task(
        self,
        job_id: str,
        stage: int,
        position: int,
        task: dict[str, Any],
        *,
        key: str,
        priority: int,
    ) -> str:
        """Queue a task of a running job and name its workflow; doing so again changes nothing."""
        workflow_id = task_id(job_id, stage, position, key)
        self._enqueue(TASKS, TASKS, workflow_id, priority, job_id, stage, position, task)
        return workflow_id

    def statuses(self, workflow_ids: Sequence[str]) -> dict[str, str]:
        """Status by workflow id, of those that exist."""
        if not workflow_ids:
            return {}
        return {
            workflow.workflow_id: workflow.status
            for workflow in self._client.list_workflows(
                workflow_ids=list(workflow_ids), load_input=False, load_output=False
            )
        }

    def output(self, workflow_id: str) -> Any:
        """Read what an ended workflow returned, or the text of its error."""
        for workflow in self._client.list_workflows(workflow_ids=[workflow_id], load_input=False):
            return workflow.output if workflow.error is None else str(workflow.error)
        return None

    def open_tasks(self, job_id: str) -> dict[str, str]:
        """Status of the job's tasks that wait or run, by workflow id."""
        workflows = self._client.list_workflows(
            workflow_id_prefix=f"{job_id}.",
            status=["ENQUEUED", "PENDING"],
            load_input=False,
            load_output=False,
        )
        return {workflow.workflow_id: workflow.status for workflow in workflows}

    def cancel(self, workflow_ids: Collection[str]) -> None:
        """Take workflows off the queue; code that runs already must look at its job's row."""
        for workflow_id in workflow_ids:
            self._client.cancel_workflow(workflow_id)

    def claims(self, executor_ids: Collection[str] | None = None) -> list[Claim]:
        """Workflows that these workers hold, or all that are held."""
        workflows = self._client.list_workflows(
            status="PENDING",
            executor_id=None if executor_ids is None else list(executor_ids),
            load_input=False,
            load_output=False,
        )
        return [
            Claim(workflow.workflow_id, workflow.queue_name or JOBS, workflow.executor_id or "")
            for workflow in workflows
        ]

    def hand_back(self, claim: Claim) -> None:
        """Queue a claimed workflow again, without counting a lost worker."""
        self._client.resume_workflow(claim.workflow_id, queue_name=claim.queue)

    def forget(self, workflow_id: str) -> None:
        """Delete the ended workflow of a job with its tasks', or of a task, to use its id anew."""
        tasks = self._client.list_workflows(
            workflow_id_prefix=f"{workflow_id}.", load_input=False, load_output=False
        )
        self._client.delete_workflows([workflow_id, *(task.workflow_id for task in tasks)])

    def prune(self, ended_before: str, *, limit: int) -> int:
        """Delete so many workflows that ended before an ISO time; returns how many there were."""
        old = self._client.list_workflows(
            status=sorted(ENDED),
            completed_before=ended_before,
            load_input=False,
            load_output=False,
            limit=limit,
        )
        if old:
            self._client.delete_workflows([workflow.workflow_id for workflow in old])
        return len(old)

    def close(self) -> None:
        """Close the connections."""
        self._client.destroy()

    def _enqueue(
        self, workflow: str, queue: str, workflow_id: str, priority: int, *arguments: Any
    ) -> None:
        options = EnqueueOptions(
            workflow_name=workflow,
            queue_name=queue,
            workflow_id=workflow_id,
            app_version=APPLICATION_VERSION,
            priority=priority,
        )
        self._client.enqueue(options, *arguments)


@dataclass(frozen=True)
class Handlers:
    """What a worker runs: a job, a quick job, a task.  They must not raise and may take hours."""

    job: Callable[[str], None]
    quick: Callable[[str], None]
    task: Callable[[str, int, int, dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Slots:
    """How much of each queue a worker holds at once, and how often it looks."""

    jobs: int
    tasks: int
    quick: int
    poll_s: float


class Engine:
    """The queue from inside a worker process; one a process."""

    def __init__(
        self, database_url: str, executor_id: str, handlers: Handlers, *, worker_losses: int
    ) -> None:
        self._active: set[str] = set()
        self._lock = threading.Lock()
        self._missing: dict[str, float] = {}
        self._executor_id = executor_id
        url = prepare(database_url)
        config = DBOSConfig(
            name=APPLICATION,
            system_database_url=url,
            executor_id=executor_id,
            application_version=APPLICATION_VERSION,
            serializer=_Json(),
            log_level="WARNING",
            sys_db_pool_size=10,
            run_migrations=False,  # `prepare` has done it
        )
        self._dbos = DBOS(config=config)
        _hush()
        self._register(handlers, worker_losses)

    def launch(self, slots: Slots) -> None:
        """Start to take work; the worker's first heartbeat must be written before."""
        DBOS.launch()
        # each look costs a few queries: an idle worker takes 5 % of a core at four a second
        for name, count, poll_s in (
            (JOBS, slots.jobs, 2 * slots.poll_s),
            (TASKS, slots.tasks, slots.poll_s),
            (QUICK, slots.quick, slots.poll_s),
        ):
            DBOS.register_queue(name, worker_concurrency=count, polling_interval_sec=poll_s)

    def stop_taking(self) -> None:
        """Take no more work; what runs goes on."""
        for event in self._dbos.background_thread_stop_events:
            event.set()

    def recover(self, dead: Sequence[str]) -> list[str]:
        """Queue again what dead workers held, counting the loss; returns the workflow ids.

        Open-source dbos has no public call for this.  Two watchdogs may race here: the update
        matches on the dead worker's name, so one of them finds nothing.
        """
        handles = DBOS._recover_pending_workflows(list(dead))
        return [handle.get_workflow_id() for handle in handles]

    def orphans(self, claims: Sequence[Claim], *, after_s: float) -> list[Claim]:
        """Claims of this worker that never started: the database failed between claim and start.

        A claim counts once it has been without a running thread for ``after_s``, so that one that
        is starting, or writing its end, is left alone.
        """
        now = time.monotonic()
        with self._lock:
            active = set(self._active)
        missing = {claim.workflow_id for claim in claims} - active
        self._missing = {name: self._missing.get(name, now) for name in missing}
        return [
            claim
            for claim in claims
            if claim.workflow_id in missing and now - self._missing[claim.workflow_id] > after_s
        ]

    def _register(self, handlers: Handlers, worker_losses: int) -> None:
        @DBOS.workflow(name=JOBS, max_recovery_attempts=PARENT_LOSSES)
        def job(job_id: str) -> None:
            with self._running(job_id):
                handlers.job(job_id)

        @DBOS.workflow(name=QUICK, max_recovery_attempts=worker_losses - 1)
        def quick(job_id: str) -> None:
            with self._running(job_id):
                handlers.quick(job_id)

        @DBOS.workflow(name=TASKS, max_recovery_attempts=worker_losses - 1)
        def task(job_id: str, stage: int, position: int, data: dict[str, Any]) -> dict[str, Any]:
            with self._running(str(DBOS.workflow_id)):
                return handlers.task(job_id, stage, position, data)

    @contextmanager
    def _running(self, workflow_id: str) -> Iterator[None]:
        """Keep the list of workflows that have a thread here."""
        with self._lock:
            self._active.add(workflow_id)
        try:
            yield
        finally:
            with self._lock:
                self._active.discard(workflow_id)


def _hush() -> None:
    """Send dbos's log through ours, warnings and worse only."""
    logger = logging.getLogger("dbos")
    logger.handlers.clear()
    logger.propagate = True
    logger.setLevel(logging.WARNING)

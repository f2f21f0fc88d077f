"""A worker process: takes jobs and tasks, beats, watches its peers, and leaves in good order."""

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.queue.code import code_version
from prtbake_storage.queue.engine import Engine, Handlers, JobQueue, Slots
from prtbake_storage.queue.failures import TaskStopped
from prtbake_storage.queue.garbage import Collector
from prtbake_storage.queue.heart import Heart
from prtbake_storage.queue.parent import JobRun
from prtbake_storage.queue.reconcile import Reconciler
from prtbake_storage.queue.settings import QueueSettings, new_executor_id
from prtbake_storage.queue.stages import JobRunner, Task, package_of
from prtbake_storage.queue.tasks import Services, TaskRun
from prtbake_storage.queue.watchdog import Watchdog
from prtbake_storage.records.database import create_database
from prtbake_storage.records.workers import Workers

_log = logging.getLogger(__name__)

LEAVE_S = 5.0
"""How long a leaving worker waits for its tasks' processes to be gone: they are killed."""


class WorkerProcess:
    """Everything a worker runs, wired together; one a process."""

    def __init__(
        self, settings: QueueSettings, runner: JobRunner, *, executor_id: str | None = None
    ) -> None:
        self._settings, self._runner = settings, runner
        self._executor_id = executor_id or new_executor_id()
        self._shutdown = threading.Event()
        self._database = create_database(settings.database_url)
        self._store = open_store(settings.blob_url, owner=self._executor_id)
        self._services = Services(
            self._database, self._store, settings, self._shutdown, package_of(runner)
        )
        self._queue = JobQueue(settings.database_url)
        handlers = Handlers(job=self._run_job, quick=self._run_quick, task=self._run_task)
        self._engine = Engine(
            settings.database_url,
            self._executor_id,
            handlers,
            worker_losses=settings.worker_losses,
        )
        self._workers = Workers(self._database)
        self._heart = Heart(self._workers, self._executor_id, settings)
        self._running_tasks = 0
        self._idle = threading.Condition()

    def run(self) -> None:
        """Work until SIGTERM or SIGINT; does not return, because the parked threads never would."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._shutdown.set())
        settings = self._settings
        code = code_version()  # now: sources that change later are not those loaded here
        # before the first claim: nobody may take our work for a dead worker's
        self._heart.beat()
        self._engine.launch(
            Slots(settings.job_slots, settings.tile_slots, settings.quick_slots, settings.poll_s)
        )
        fields = {"worker": self._executor_id, "pid": os.getpid(), "code": code}
        _log.info("worker.started", extra=fields)
        watchdog = Watchdog(
            engine=self._engine,
            queue=self._queue,
            workers=self._workers,
            heart=self._heart,
            store=self._store,
            executor_id=self._executor_id,
            settings=settings,
        )
        threading.Thread(target=watchdog.run, args=(self._shutdown,), daemon=True).start()
        collector = Collector(self._database, self._store, self._runner, settings)
        threading.Thread(target=collector.run, args=(self._shutdown,), daemon=True).start()
        Reconciler(
            self._database,
            self._queue,
            every_s=settings.reconcile_s,
            dead_after_s=settings.dead_after_s,
            retention_s=settings.retention_s,
        ).start()
        self._heart.run(self._shutdown)
        self._leave()

    def _leave(self) -> None:
        """Stop the children, hand the claims back uncounted, say goodbye, and go."""
        _log.info("worker.leaving", extra={"worker": self._executor_id})
        self._engine.stop_taking()
        with self._idle:
            self._idle.wait_for(lambda: self._running_tasks == 0, timeout=LEAVE_S)
        time.sleep(self._settings.poll_s)  # a look at the queue that was under way has ended now
        try:
            for claim in self._queue.claims([self._executor_id]):
                self._queue.hand_back(claim)
            # a look at the queue may wait for a lock and claim after this: so a peer looks again,
            # and forgets us
            self._workers.mark_gone(self._executor_id)
            self._store.sweep_scratch(owner=self._executor_id)
        except Exception as error:  # noqa: BLE001 - peers will find out by our silence
            _log.warning("worker.leave_failed", extra={"error": str(error)[:200]})
        _log.info("worker.left", extra={"worker": self._executor_id})
        os._exit(0)  # the parked threads never end

    def _run_job(self, job_id: str) -> None:
        try:
            self._job(job_id, quick=False).run()
        except TaskStopped:
            _park()

    def _run_quick(self, job_id: str) -> None:
        try:
            with self._counted():
                self._job(job_id, quick=True).run()
        except TaskStopped:
            _park()

    def _run_task(
        self, job_id: str, stage: int, position: int, data: dict[str, Any]
    ) -> dict[str, Any]:
        try:
            with self._counted():
                run = TaskRun(self._services, job_id, stage, position, Task.from_dict(data))
                return run.run().to_dict()
        except TaskStopped:
            _park()

    def _job(self, job_id: str, *, quick: bool) -> JobRun:
        return JobRun(self._services, self._queue, self._runner, job_id, quick=quick)

    @contextmanager
    def _counted(self) -> Iterator[None]:
        """Count what may have a child alive."""
        with self._idle:
            self._running_tasks += 1
        try:
            yield
        finally:
            with self._idle:
                self._running_tasks -= 1
                self._idle.notify_all()


def _park() -> NoReturn:
    """Hold a workflow's thread: returning or raising would be recorded as the workflow's end."""
    while True:
        threading.Event().wait()


def run_worker(
    settings: QueueSettings, runner: JobRunner, *, executor_id: str | None = None
) -> None:
    """Run a worker in this process; does not return."""
    WorkerProcess(settings, runner, executor_id=executor_id).run()

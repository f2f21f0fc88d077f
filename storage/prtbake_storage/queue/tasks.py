"""Run one task of a job on this worker: recall it, or run its child, retry, remember."""

import logging
import threading
import time
from dataclasses import dataclass
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.jobs import JobError
from prtbake_storage.queue.attempts import Attempts
from prtbake_storage.queue.child import run_task_in_child
from prtbake_storage.queue.failures import SHUTDOWN, TaskFailed, TaskStopped, describe
from prtbake_storage.queue.memo import Memory, recall, remember
from prtbake_storage.queue.patience import patiently
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import Task
from prtbake_storage.records.database import Database
from prtbake_storage.records.events import Events
from prtbake_storage.records.runs import Runs, TaskProgress

_log = logging.getLogger(__name__)

PROGRESS_EVERY_S = 1.0
"""At most one row of progress a second and task."""


@dataclass(frozen=True)
class Services:
    """What jobs and tasks use on a worker; ``package`` is where tasks' functions must lie."""

    database: Database
    store: BlobStore
    settings: QueueSettings
    shutdown: threading.Event
    package: str

    @property
    def runs(self) -> Runs:
        """Jobs as workers see them."""
        return Runs(self.database)


@dataclass(frozen=True)
class Outcome:
    """How a task ended: ``done``, ``failed`` or ``stopped``.

    Attributes
    ----------
    key
        Under what the result of a task that is done is remembered: the name that the task has with
        the code of the worker that ran it, which in the midst of an upgrade may not be the
        parent's.
    recalled
        Whether it was not run for this: its costs are of another time.
    """

    status: str
    error: JobError | None = None
    key: str = ""
    recalled: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Write as JSON."""
        error = self.error.model_dump() if self.error is not None else None
        return {
            "status": self.status,
            "error": error,
            "key": self.key,
            "recalled": self.recalled,
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> "Outcome":
        """Read back."""
        error = JobError.model_validate(data["error"]) if data["error"] else None
        # a worker of before this was told leaves it out
        return Outcome(data["status"], error, data["key"], bool(data.get("recalled", False)))


class TaskRun:
    """One run of a task on this worker."""

    def __init__(
        self, services: Services, job_id: str, stage: int, position: int, task: Task
    ) -> None:
        self._services = services
        self._job_id, self._stage, self._position, self._task = job_id, stage, position, task
        self._last_progress = 0.0
        self._fields = {
            "job_id": job_id, "stage": stage, "position": position,
            "task": task.title,
        }  # fmt: skip
        self._attempts = Attempts(
            services.settings, services.shutdown, check_stop=self._check_stop, tell=self._retrying
        )

    def run(self) -> Outcome:
        """Run to an outcome; raises `TaskStopped` only when this worker shuts down."""
        store, task, attempts = self._services.store, self._task, self._attempts
        try:
            self._check_stop()
            known = attempts.make(f"recalling {task.title}", recall, store, task.key)
            if known is None:
                memory = attempts.make(f"running {task.title}", self._once)
                attempts.make(f"remembering {task.title}", remember, store, task.key, memory)
        except TaskStopped as stopped:
            _log.info("task.stopped", extra={**self._fields, "reason": stopped.reason})
            if stopped.reason == SHUTDOWN:
                raise
            return Outcome("stopped")
        except TaskFailed as failed:
            _log.warning("task.failed", extra={**self._fields, "error": failed.error.detail})
            return Outcome("failed", failed.error)
        except Exception as error:  # noqa: BLE001 - logged whole, and the outcome says it
            _log.exception("task.crashed", extra=self._fields)
            return Outcome("failed", describe(error))
        return Outcome("done", key=self._task.key, recalled=known is not None)

    def _once(self) -> Memory:
        started = time.monotonic()
        _log.info("task.started", extra=self._fields)
        with self._services.store.scratch() as scratch:
            memory = run_task_in_child(
                self._task,
                package=self._services.package,
                store_url=self._services.store.url,
                scratch=scratch,
                on_message=self._on_message,
                should_stop=self._should_stop,
                check_s=self._services.settings.cancel_check_s,
            )
        seconds = time.monotonic() - started
        _log.info("task.done", extra={**self._fields, "seconds_s": seconds})
        return memory

    def _retrying(self, detail: str) -> None:
        _log.warning("task.retried", extra={**self._fields, "error": detail})
        self._log_event(f"retrying after: {detail}")

    def _check_stop(self) -> None:
        if (reason := self._should_stop()) is not None:
            raise TaskStopped(reason)

    def _should_stop(self) -> str | None:
        if self._services.shutdown.is_set():
            return SHUTDOWN
        stop = patiently(self._services.shutdown, self._services.runs.stop, self._job_id)
        return stop.state.value if stop is not None else None

    def _on_message(self, message: dict[str, Any]) -> None:
        if "log" in message:
            self._log_event(**message["log"])
            return
        done, total, unit = message["progress"]
        now = time.monotonic()
        if now - self._last_progress < PROGRESS_EVERY_S:
            return
        self._last_progress = now
        patiently(
            self._services.shutdown,
            self._services.runs.task_progress,
            self._job_id,
            self._stage,
            TaskProgress(self._position, done, total, unit),
        )

    def _log_event(self, message: str, **fields: Any) -> None:
        _log.info("task.log", extra={**self._fields, "line": message})
        patiently(
            self._services.shutdown,
            Events(self._services.database).log,
            self._job_id,
            message,
            task=self._task.title,
            **fields,
        )

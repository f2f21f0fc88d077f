"""Real worker processes on a real database, for the acceptance tests."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil

from prtbake_storage.contract.jobs import Job
from prtbake_storage.queue.engine import JobQueue, engine_url
from prtbake_storage.queue.settings import QueueSettings, new_executor_id
from prtbake_storage.queue.supervisor import Supervisor
from prtbake_storage.records import Jobs, NewJob, Workers, create_database
from support.folders import files_in

REGISTRY = "toy_registry:REGISTRY"
PATIENCE_S = 60.0
"""Deadline of everything that must happen at all; what must happen fast has its own."""


class Note(NamedTuple):
    """What a toy task left behind: its name, its process, and the worker above it."""

    name: str
    pid: int
    worker: int


class Fleet:
    """A database, a blob store and the processes that share them."""

    def __init__(self, folder: Path, database_url: str) -> None:
        self.notes = folder / "notes"
        self.notes.mkdir()
        self.settings = QueueSettings(
            data_dir=folder,
            database_url=database_url,
            heartbeat_s=0.5,
            dead_after_s=4.0,
            poll_s=0.1,
            cancel_check_s=0.3,
            retry_wait_s=0.1,
            worker_losses=2,
            reconcile_s=1.0,
        )
        paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        self.environment = {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "PRTBAKE_TOY_NOTES": str(self.notes),
        }
        self.database = create_database(self.settings.database_url)
        self.jobs, self.workers = Jobs(self.database), Workers(self.database)
        self.queue = JobQueue(self.settings.database_url)
        self.supervisor: Supervisor | None = None
        self._processes: list[subprocess.Popen[bytes]] = []

    def supervise(self, n_workers: int = 2) -> None:
        """Start supervised workers and wait until they beat."""
        self.supervisor = Supervisor(
            n_workers, self.settings, registry=REGISTRY, environment=self.environment
        ).start()
        self.await_workers(n_workers)

    def spawn(self) -> subprocess.Popen[bytes]:
        """Start a worker that nobody looks after."""
        command = [sys.executable, "-m", "prtbake_storage.queue.worker_main"]
        process = subprocess.Popen(
            [*command, "--registry", REGISTRY, "--executor-id", new_executor_id()],
            env={**os.environ, **self.settings.to_env(), **self.environment},
        )
        self._processes.append(process)
        return process

    def await_workers(self, count: int) -> None:
        """Wait until so many workers beat."""
        dead_after_s = self.settings.dead_after_s
        self.until(
            lambda: (
                sum(w.state == "up" and w.age_s < dead_after_s for w in self.workers.all()) >= count
            ),
            f"{count} workers",
        )

    def submit(
        self, kind: str = "tiles", *, quick: bool = False, timeout_s: float | None = None,
        retry_of: str | None = None, **request: object,
    ) -> str:  # fmt: skip
        """Submit as the service does: row, then queue."""
        job_id = f"job-{uuid.uuid4().hex[:12]}"
        new = NewJob(
            id=job_id, kind=kind, request=dict(request), quick=quick, timeout_s=timeout_s,
            retry_of=retry_of,
        )  # fmt: skip
        self.jobs.create(new)
        self.queue.submit(job_id, quick=quick)
        return job_id

    def ended(self, job_id: str) -> Job:
        """Wait for a job's end."""
        self.until(lambda: self.jobs.get(job_id).state.terminal, f"the end of {job_id}")
        return self.jobs.get(job_id)

    def noted(self, kind: str, prefix: str = "") -> list[Note]:
        """What the toy tasks noted, oldest first."""
        found = []
        for path in self.notes.glob(f"{kind}.{prefix}*"):
            _, name, pid, moment = path.name.split(".")
            text = path.read_text()
            if text:
                found.append((int(moment), Note(name, int(pid), int(text))))
        return [note for _, note in sorted(found)]

    def counts(self, kind: str, prefix: str = "") -> Counter[str]:
        """How often each toy task noted something."""
        return Counter(note.name for note in self.noted(kind, prefix))

    def await_note(self, kind: str, prefix: str, count: int = 1) -> list[Note]:
        """Wait until the toy tasks have noted so much."""
        self.until(lambda: len(self.noted(kind, prefix)) >= count, f"{count} x {kind} {prefix}")
        return self.noted(kind, prefix)

    def running(self, prefix: str) -> list[Note]:
        """Tasks that have begun, have not noted their end, and whose process is alive."""
        finished = {note.pid for note in self.noted("finished", prefix)}
        started = self.noted("started", prefix)
        return [note for note in started if note.pid not in finished and is_alive(note.pid)]

    def await_running(self, prefix: str) -> Note:
        """Wait until a task runs; gives the one that started last, with most of its time ahead."""
        self.until(lambda: bool(self.running(prefix)), f"a running {prefix}")
        return self.running(prefix)[-1]

    def freeze(self, worker: int) -> None:
        """Stop a process where it holds no lock: nobody can take SQLite's from a sleeper."""
        database = self.settings.data_dir / "prtbake.sqlite"
        databases = [database, Path(engine_url(f"sqlite:///{database}").removeprefix("sqlite:///"))]
        while True:
            os.kill(worker, signal.SIGSTOP)
            self.until(lambda: _stopped(worker), "all of its threads to stop")
            if all(_writable(path) for path in databases):
                return
            os.kill(worker, signal.SIGCONT)
            time.sleep(0.05)

    def leftovers(self) -> list[Path]:
        """Files in scratch."""
        return files_in(self.settings.data_dir / "blobs" / "scratch")

    @staticmethod
    def until(condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
        """Wait for a condition; returns the seconds it took."""
        begin = time.monotonic()
        while not condition():
            if time.monotonic() - begin > patience_s:
                raise AssertionError(f"waited {patience_s} s for {what}")
            time.sleep(0.02)
        return time.monotonic() - begin

    def close(self) -> None:
        """End every process."""
        if self.supervisor is not None:
            self.supervisor.stop()
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()
        self.queue.close()
        self.database.dispose()


def _stopped(pid: int) -> bool:
    states = []
    for status in Path(f"/proc/{pid}/task").glob("*/stat"):
        with suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            states.append(status.read_text().rpartition(")")[2].split()[0])
    return set(states) == {"T"}


def _writable(path: Path) -> bool:
    connection = sqlite3.connect(path, timeout=1.0, isolation_level=None)
    try:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("ROLLBACK")
    except sqlite3.OperationalError:
        return False
    finally:
        connection.close()
    return True


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for yet does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False

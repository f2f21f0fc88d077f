"""A whole installation as processes, and what can be seen of it from outside."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from prtbake import Client
from prtbake.launch import LocalService
from prtbake_storage.blobs import open_store
from prtbake_storage.contract.resources import EnvironmentRegistration, MeshRegistration
from prtbake_storage.records import Jobs, Workers, create_database
from support.folders import files_in

PATIENCE_S = 240.0
"""Deadline of what must happen at all: a job takes 15 s on a quiet machine."""
EAGER = {
    "PRTBAKE_HEARTBEAT_S": "0.5",
    "PRTBAKE_RECONCILE_S": "1",
    "PRTBAKE_RECONCILE_EVERY": "PT1S",
}
"""Settings under which a loss that the supervisor saw is acted on soon; silence counts as ever."""


class Installation:
    """A service and two workers on a folder, from outside: REST, logs, processes, files."""

    def __init__(self, local: LocalService, database_url: str) -> None:
        self.local = local
        self.folder = local.data_dir
        self.database_url = database_url
        self.database = create_database(database_url)
        self.jobs = Jobs(self.database)
        self.client = Client(local.url, key=local.key)
        self.store = open_store((self.folder / "blobs").as_uri(), owner="test")
        self.mesh = self._registered(MeshRegistration, name="teapot", tessellation=4)
        self.environment = self._registered(EnvironmentRegistration, name="sun_sky", width=64)

    def _registered(self, registration: Any, **builtin: Any) -> str:
        resource = self.client.register(registration.model_validate({"builtin": builtin}))
        assert resource.state == "ready"
        return resource.id

    def close(self) -> None:
        """Close what this process holds."""
        self.client.close()
        self.database.dispose()

    def command(self, *arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
        """Run ``prtbake`` against this installation and check what it exits with."""
        line = [sys.executable, "-m", "prtbake.cli.main", "--data-dir", str(self.folder)]
        done = subprocess.run(
            [*line, *map(str, arguments)],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"exit {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    def log(self, job_id: str, event: str) -> list[dict[str, Any]]:
        """What the workers logged of a job under one name."""
        found = []
        for line in (self.folder / "logs" / "workers.log").read_text().splitlines():
            record = json.loads(line) if line.startswith("{") else {}
            if record.get("job_id") == job_id and record.get("event") == event:
                found.append(record)
        return found

    def starts(self, job_id: str) -> Counter[tuple[int, int]]:
        """How often each task of a job was started, by stage and position."""
        return Counter((one["stage"], one["position"]) for one in self.log(job_id, "task.started"))

    def workers(self) -> dict[str, psutil.Process]:
        """The worker processes by executor id."""
        # nobody may read a worker's environment, so its own records tell whose it is
        ours = {worker.executor_id for worker in Workers(self.database).all()}
        found = {}
        for process in psutil.Process().children(recursive=True):
            line = command_line(process)
            if "--executor-id" in line and (name := line[line.index("--executor-id") + 1]) in ours:
                found[name] = process
        return found

    def tasks(self, worker: psutil.Process | None = None) -> list[psutil.Process]:
        """The processes that run tasks, of one worker or of all."""
        above = [worker] if worker is not None else list(self.workers().values())
        return [
            child
            for one in above
            for child in children_of(one)
            if "prtbake_storage.queue.child_main" in command_line(child)
        ]

    def leftovers(self) -> list[Path]:
        """Files in scratch."""
        return files_in(self.folder / "blobs" / "scratch")


def command_line(process: psutil.Process) -> list[str]:
    """A process's arguments; none of one that has ended."""
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def children_of(process: psutil.Process) -> list[psutil.Process]:
    """A process's living children."""
    try:
        return [one for one in process.children() if one.status() != psutil.STATUS_ZOMBIE]
    except psutil.Error:
        return []


def is_alive(process: psutil.Process) -> bool:
    """Whether a process runs; one that nobody has waited for yet does not."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def until(condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
    """Wait for a condition; returns the seconds it took."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > patience_s:
            raise AssertionError(f"waited {patience_s} s for {what}")
        time.sleep(0.02)
    return time.monotonic() - begin


@contextmanager
def installed(
    folder: Path, *, database_url: str | None = None, settings: dict[str, str] | None = None
) -> Iterator[Installation]:
    """Start an installation; a URL alone puts it on another database."""
    variables = dict(settings or {})
    if database_url is not None:
        variables["PRTBAKE_DATABASE_URL"] = database_url
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        local = LocalService(folder, n_workers=2)
        local.__enter__()
    try:
        installation = Installation(local, database_url or f"sqlite:///{folder / 'prtbake.sqlite'}")
        try:
            yield installation
        finally:
            installation.close()
    finally:
        local.stop()


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def stop(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> int:
    """Ask a process to leave and wait for it; kills it if it does not."""
    process.send_signal(number)
    try:
        return process.wait(timeout=60.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


def without_settings(kept: tuple[str, ...]) -> list[str]:
    """Name the variables of prtbake that the caller's shell has set, but for those kept."""
    return [name for name in os.environ if name.startswith("PRTBAKE_") and name not in kept]

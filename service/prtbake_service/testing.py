"""A real service on a real port, in a thread: for tests of the service and of its clients."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import uvicorn

from prtbake_service.app import create_app
from prtbake_service.auth import KEY_FILE
from prtbake_service.backend import Backend
from prtbake_service.settings import ServiceSettings
from prtbake_storage.contract.jobs import JobError, JobState, Progress
from prtbake_storage.records import NewArtefact, Runs, Stop

START_S = 30.0


@dataclass(frozen=True)
class LiveService:
    """A running service and what it stands on."""

    url: str
    key: str
    backend: Backend
    data_dir: Path

    @property
    def runs(self) -> Runs:
        """What workers use: a test that has none moves jobs by hand."""
        return Runs(self.backend.database)

    def begin(self, job_id: str) -> None:
        """Do what a worker does when it takes a job."""
        self.runs.start(job_id)

    def succeed(self, job_id: str, result: dict[str, Any], **files: bytes) -> None:
        """End a job well, with files; ``name_ext=...`` stands for the file ``name.ext``."""
        self.begin(job_id)
        artefacts = [
            NewArtefact(
                name.replace("_", ".", 1),
                "application/octet-stream",
                self.backend.blobs.put_bytes(data),
                len(data),
            )
            for name, data in files.items()
        ]
        self.runs.succeed(job_id, result=result, artefacts=artefacts, progress=Progress())

    def answer_next(self, kind: str, finish: Callable[[str], object]) -> None:
        """Play the worker: end the next quick job of a kind that comes in."""
        known = self._quick(kind)

        def play() -> None:
            deadline = time.monotonic() + START_S
            while time.monotonic() < deadline:
                for job_id in self._quick(kind) - known:
                    finish(job_id)
                    return
                time.sleep(0.005)

        threading.Thread(target=play, daemon=True).start()

    def _quick(self, kind: str) -> set[str]:
        page = self.backend.jobs.page(internal=True, kinds=[kind], limit=1000)
        return {job.id for job in page.items}

    def fail(self, job_id: str, error: JobError) -> None:
        """End a job badly."""
        self.begin(job_id)
        self.runs.close(job_id, Stop(JobState.failed, error))


def quick_settings(data_dir: Path, **changes: object) -> ServiceSettings:
    """Return settings under which nothing takes long."""
    values: dict[str, object] = {
        "data_dir": data_dir,
        "database_url": f"sqlite:///{data_dir}/prtbake.sqlite",
        "blob_url": (data_dir / "blobs").as_uri(),
        "parse_wait": timedelta(seconds=0.15),
        "poll_every": timedelta(milliseconds=20),
        "heartbeat_every": timedelta(milliseconds=100),
        "long_poll_max": timedelta(seconds=5),
        "max_upload_bytes": 4 << 20,
        "max_request_bytes": 64 << 10,
        # nothing is reconciled behind a test's back after the start
        "reconcile_every": timedelta(hours=1),
    }
    return ServiceSettings.model_validate(values | changes)


@contextmanager
def live_service(settings: ServiceSettings) -> Iterator[LiveService]:
    """Run a service, without workers, while the context is open."""
    app = create_app(settings)
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        deadline = time.monotonic() + START_S
        while not server.started:
            if time.monotonic() > deadline or not thread.is_alive():
                raise RuntimeError("the service did not start")
            time.sleep(0.01)
        backend: Backend = app.state.backend
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        key = (settings.data_dir / KEY_FILE).read_text().strip()
        yield LiveService(url, key, backend, settings.data_dir)
        backend.closing.set()
    finally:
        server.should_exit = True
        thread.join(timeout=START_S)
        listener.close()

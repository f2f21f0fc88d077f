"""A real service on a real port: uvicorn in a thread, SQLite and blobs in a temporary folder."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
import uvicorn
from prtbake_service.app import create_app
from prtbake_service.auth import KEY_FILE
from prtbake_service.backend import Backend
from prtbake_service.settings import ServiceSettings


class LiveService:
    """A running service, what it stands on, and a client with its key."""

    def __init__(self, url: str, backend: Backend, data_dir: Path) -> None:
        self.url = url
        self.backend = backend
        self.data_dir = data_dir
        self.key = (data_dir / KEY_FILE).read_text().strip()
        self.http = httpx.Client(
            base_url=url,
            headers={"Authorization": f"Bearer {self.key}"},
            timeout=20.0,
            trust_env=False,
        )


@contextmanager
def run_service(settings: ServiceSettings) -> Iterator[LiveService]:
    app = create_app(settings)
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(
        app, log_config=None, access_log=False, timeout_graceful_shutdown=1, lifespan="on"
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    deadline = time.monotonic() + 20
    while not server.started:
        if time.monotonic() > deadline or not thread.is_alive():
            raise RuntimeError("the service did not start")
        time.sleep(0.01)
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    service = LiveService(url, app.state.backend, settings.data_dir)
    try:
        yield service
    finally:
        service.http.close()
        server.should_exit = True
        thread.join(timeout=20)
        listener.close()


def quick_settings(data_dir: Path, **changes: object) -> ServiceSettings:
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


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """One service for all tests, without workers: jobs stay queued unless a test plays worker."""
    data_dir = tmp_path_factory.mktemp("service")
    with run_service(quick_settings(data_dir)) as live:
        yield live

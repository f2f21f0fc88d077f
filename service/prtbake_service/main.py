"""The service as a process: ``python -m prtbake_service.main``."""

import logging
import socket
from types import FrameType

import uvicorn
from fastapi import FastAPI

from prtbake_service.app import create_app
from prtbake_service.backend import Backend
from prtbake_service.middleware import REQUEST_ID
from prtbake_service.settings import ServiceSettings
from prtbake_storage.queue.logs import configure_logging
from prtbake_storage.queue.privacy import forbid_reading

GRACE_S = 3
"""Open event streams would hold a shutdown up for ever; clients take them up again."""


class PoliteServer(uvicorn.Server):
    """Tell those who wait for something before connections are closed on them."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to leave on SIGINT or SIGTERM."""
        backend = getattr(self._app.state, "backend", None)
        if isinstance(backend, Backend):
            backend.closing.set()
        super().handle_exit(sig, frame)


def add_request_id(record: logging.LogRecord) -> bool:
    """Mark a log record with the request it belongs to."""
    if (request_id := REQUEST_ID.get()) is not None:
        record.request_id = request_id
    return True


def main() -> None:
    """Serve until SIGINT or SIGTERM."""
    forbid_reading()  # tasks may run beside us, as the same user
    settings = ServiceSettings()
    configure_logging(service="rest")
    for handler in logging.getLogger().handlers:
        handler.addFilter(add_request_id)
    for noisy in ("alembic", "httpx"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
    )
    sockets = None if settings.fd is None else [socket.socket(fileno=settings.fd)]
    logging.getLogger(__name__).info("service.start", extra={"blobs": settings.blobs})
    PoliteServer(config, app).run(sockets=sockets)


if __name__ == "__main__":
    main()

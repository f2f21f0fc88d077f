"""The service as a process: ``python -m prtbake_service.main``."""

import logging
import socket

import uvicorn

from prtbake_service.app import create_app
from prtbake_service.middleware import REQUEST_ID
from prtbake_service.settings import ServiceSettings
from prtbake_storage.queue.logs import configure_logging

GRACE_S = 3
"""Open event streams would hold a shutdown up for ever; clients take them up again."""


def add_request_id(record: logging.LogRecord) -> bool:
    """Mark a log record with the request it belongs to."""
    if (request_id := REQUEST_ID.get()) is not None:
        record.request_id = request_id
    return True


def main() -> None:
    """Serve until SIGINT or SIGTERM."""
    settings = ServiceSettings()
    configure_logging(service="rest")
    for handler in logging.getLogger().handlers:
        handler.addFilter(add_request_id)
    for noisy in ("alembic", "httpx"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    config = uvicorn.Config(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
    )
    sockets = None if settings.fd is None else [socket.socket(fileno=settings.fd)]
    logging.getLogger(__name__).info("service.start", extra={"blobs": settings.blobs})
    uvicorn.Server(config).run(sockets=sockets)


if __name__ == "__main__":
    main()

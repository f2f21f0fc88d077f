"""The service as a process: ``python -m prtbake_service.main``."""

import logging
import socket

import uvicorn

from prtbake_service.app import create_app
from prtbake_service.logs import configure
from prtbake_service.settings import ServiceSettings

GRACE_S = 3
"""Open event streams would hold a shutdown up for ever; clients take them up again."""


def main() -> None:
    """Serve until SIGINT or SIGTERM."""
    settings = ServiceSettings()
    configure(as_json=settings.log_json)
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

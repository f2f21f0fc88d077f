"""Structured logs: one JSON object a line, with the id of the request it belongs to."""

import logging
import sys

import structlog
from structlog.typing import EventDict, WrappedLogger

from prtbake_service.middleware import REQUEST_ID


def _add_request_id(logger: WrappedLogger, method: str, event: EventDict) -> EventDict:
    del logger, method
    if (request_id := REQUEST_ID.get()) is not None:
        event["request_id"] = request_id
    return event


def configure(*, as_json: bool) -> None:
    """Send everything that is logged to standard error, as JSON or for people."""
    render: structlog.typing.Processor = (
        structlog.processors.JSONRenderer() if as_json else structlog.dev.ConsoleRenderer()
    )
    formatter = structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.stdlib.add_log_level,
            structlog.stdlib.add_logger_name,
            structlog.stdlib.ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            _add_request_id,
        ],
        processors=[
            structlog.stdlib.ProcessorFormatter.remove_processors_meta,
            structlog.processors.format_exc_info,
            render,
        ],
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter)
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    for noisy in ("alembic", "dbos", "httpx", "uvicorn.access"):
        logging.getLogger(noisy).setLevel(logging.WARNING)

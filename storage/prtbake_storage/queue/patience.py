"""Waiting out a database that is away for a moment."""

import logging
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from sqlalchemy.exc import DBAPIError, TimeoutError

from prtbake_storage.queue.failures import SHUTDOWN, TaskStopped

P = ParamSpec("P")
R = TypeVar("R")

RETRY_S = 0.5

_log = logging.getLogger(__name__)


def patiently(stop: threading.Event, call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call until the database answers; a job of hours must not fail for a restart of PostgreSQL.

    Errors that the next attempt would meet again (a broken constraint, a bad value) are raised.
    Once ``stop`` is set the worker is leaving, and `TaskStopped` says so.
    """
    waited = False
    while True:
        try:
            return call(*args, **kwargs)
        except (DBAPIError, TimeoutError) as error:
            if not _passing(error):
                raise
            if stop.is_set():
                raise TaskStopped(SHUTDOWN) from error
            if not waited:
                _log.warning("database.away", extra={"error": str(error)[:200]})
            waited = True
            stop.wait(RETRY_S)


def _passing(error: DBAPIError | TimeoutError) -> bool:
    if isinstance(error, TimeoutError):
        return True
    return error.connection_invalidated or type(error).__name__ in (
        "OperationalError",
        "InterfaceError",
    )

"""Waiting for something in the database to change, without holding a thread."""

import re
import threading
import time
from collections.abc import Callable
from datetime import timedelta
from typing import TypeVar

import anyio
from starlette.concurrency import run_in_threadpool

from prtbake_service.settings import ServiceSettings

T = TypeVar("T")
_WAIT = re.compile(r"(?:^|[,;\s])wait\s*=\s*(\d{1,6})(?:$|[,;\s])", re.ASCII | re.IGNORECASE)


def preferred_wait(prefer: str | None, settings: ServiceSettings) -> timedelta:
    """Return how long a request wants to wait for its quick job: ``Prefer: wait=N`` (RFC 7240)."""
    match = _WAIT.search(prefer or "")
    if match is None:
        return settings.parse_wait
    return min(timedelta(seconds=int(match[1])), settings.long_poll_max)


async def wait_until(
    read: Callable[[], T],
    done: Callable[[T], bool],
    *,
    closing: threading.Event,
    at_most: timedelta,
    every: timedelta,
) -> T:
    """Read until ``done`` says so, the time is over or the process leaves; return the last."""
    deadline = time.monotonic() + at_most.total_seconds()
    while True:
        value = await run_in_threadpool(read)
        left = deadline - time.monotonic()
        if left <= 0 or closing.is_set() or done(value):
            return value
        await anyio.sleep(min(left, every.total_seconds()))

"""Waiting for something in the database to change, without holding a thread."""

import threading
import time
from collections.abc import Callable
from datetime import timedelta
from typing import TypeVar

import anyio
from starlette.concurrency import run_in_threadpool

T = TypeVar("T")


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

import asyncio
import threading
import time
from datetime import timedelta
from pathlib import Path

import pytest

from prtbake_service.testing import quick_settings
from prtbake_service.waiting import preferred_wait, wait_until


@pytest.mark.parametrize(
    ("prefer", "seconds"),
    [
        (None, 0.15),
        ("wait=2", 2),
        ("respond-async, WAIT = 3", 3),
        ("wait=99999", 5),  # the service's longest
        ("wait=-1", 0.15),
        ("await=3", 0.15),
        ("wait=3x", 0.15),
    ],
)
def test_preferred_wait(tmp_path: Path, prefer: str | None, seconds: float) -> None:
    settings = quick_settings(tmp_path)
    assert preferred_wait(prefer, settings) == timedelta(seconds=seconds)


def wait(done: bool, closing: threading.Event, at_most_s: float) -> tuple[int, float]:
    reads = []

    def read() -> int:
        reads.append(0)
        return len(reads)

    start = time.monotonic()
    last = asyncio.run(
        wait_until(
            read,
            lambda _: done,
            closing=closing,
            at_most=timedelta(seconds=at_most_s),
            every=timedelta(milliseconds=20),
        )
    )
    return last, time.monotonic() - start


def test_it_reads_once_when_there_is_nothing_to_wait_for() -> None:
    assert wait(True, threading.Event(), 60)[0] == 1
    assert wait(False, threading.Event(), 0)[0] == 1


def test_it_reads_again_until_the_time_is_over() -> None:
    reads, seconds = wait(False, threading.Event(), 0.1)
    assert reads > 1
    assert seconds >= 0.1


def test_a_leaving_process_waits_for_nothing() -> None:
    closing = threading.Event()
    closing.set()
    assert wait(False, closing, 60)[0] == 1

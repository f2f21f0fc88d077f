"""A job's history as server-sent events."""

import time
from collections.abc import AsyncIterator

import anyio
from starlette.concurrency import run_in_threadpool

from prtbake_service.backend import Backend
from prtbake_storage.contract.jobs import Event
from prtbake_storage.errors import NotFound

RECONNECT_MS = 1000
HEARTBEAT = b": heartbeat\n\n"


def encode(event: Event) -> bytes:
    """Write one event; JSON has no line breaks, so its data is one line."""
    return f"id: {event.id}\nevent: {event.type}\ndata: {event.model_dump_json()}\n\n".encode()


async def stream_events(
    backend: Backend, job_id: str, after: int, *, follow: bool
) -> AsyncIterator[bytes]:
    """Yield what happened after an event, then what happens, until the job has ended."""
    yield f"retry: {RECONNECT_MS}\n\n".encode()
    last = after
    spoken = time.monotonic()
    heartbeat_s = backend.settings.heartbeat_every.total_seconds()
    while True:
        ended, events = await run_in_threadpool(_read, backend, job_id, last)
        for event in events:
            yield encode(event)
            last = event.id
        if events:
            spoken = time.monotonic()
            continue
        if ended or not follow or backend.closing.is_set():
            return
        if time.monotonic() - spoken >= heartbeat_s:
            yield HEARTBEAT
            spoken = time.monotonic()
        await anyio.sleep(backend.settings.poll_every.total_seconds())


def is_over(backend: Backend, job_id: str, after: int) -> bool:
    """Whether the job has ended and everything after an event has been told."""
    ended, events = _read(backend, job_id, after)
    return ended and not events


def _read(backend: Backend, job_id: str, after: int) -> tuple[bool, list[Event]]:
    # the state first: what is written before a job ends is then read below
    try:
        ended = backend.jobs.get(job_id).state.terminal
    except NotFound:
        return True, []
    return ended, backend.events.after(job_id, after)

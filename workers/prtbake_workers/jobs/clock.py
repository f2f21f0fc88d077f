"""Task ``look``: what time it is, once: a job that is taken up again sees the same."""

import time
from typing import Any

from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Task

_MODULE = "prtbake_workers.jobs.clock"


def task(started: float, place: str) -> Task:
    """Make the task; ``started`` (seconds since 1970) and ``place`` make it this job's own."""
    return Task(f"{_MODULE}:look", {"started": started, "place": place}, label="clock")


def look(args: dict[str, Any], _context: TaskContext) -> dict[str, Any]:
    """Task: tell the seconds since the job started."""
    return {"elapsed": max(0.0, time.time() - args["started"])}

"""Tasks that leave at a point in time: what they were doing is given up, and the result says so."""

import importlib
import signal
import time
from dataclasses import replace
from types import FrameType
from typing import Any

from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Task

_MODULE = "prtbake_workers.jobs.leaving"
_PACKAGE = "prtbake_workers.jobs."
LATE = {"late": True}
"""The result of a task that left."""

AGAIN_S = 1.0
"""Between two alarms, once the time is out."""


class _TooLate(BaseException):
    """The time is out; no handler of errors may take it for one."""


def until(task: Task, when: float) -> Task:
    """Make a task leave at ``when``, in seconds since 1970."""
    args = {"function": task.function, "args": task.args, "when": when}
    return replace(task, function=f"{_MODULE}:run", args=args)


def run(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: do what another does, or be `LATE`.

    A product or a batch of rays under way is finished first: these take a second at most.
    """
    module, _, name = args["function"].partition(":")
    if not module.startswith(_PACKAGE):
        raise ValueError(f"{args['function']} is no task of a job")
    # an import takes most of a second, and many tasks may be left to start
    if args["when"] <= time.time():
        return dict(LATE)
    function = getattr(importlib.import_module(module), name)
    left = args["when"] - time.time()
    if left <= 0.0:
        return dict(LATE)
    over = False

    def late(_number: int, _frame: FrameType | None) -> None:
        if not over:
            raise _TooLate

    before = signal.signal(signal.SIGALRM, late)
    try:
        try:
            # again and again: code that Python cannot leave, as a finaliser, swallows the first
            signal.setitimer(signal.ITIMER_REAL, left, AGAIN_S)
            done: dict[str, Any] = function(args["args"], context)
            return done
        finally:
            over = True
    except _TooLate:
        return dict(LATE)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)

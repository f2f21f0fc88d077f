"""The process that runs one task: ``python -m prtbake_storage.queue.child_main``.

It reads one JSON line on stdin, ``{"task", "store_url", "scratch", "parent"}``, and writes JSON
lines on stdout: ``{"progress": [done, total, unit]}``, ``{"log": {...}}`` and at the end
``{"result", "seconds", "peak_memory_bytes"}`` or ``{"error", "retryable"}``.  It imports neither
the job engine nor the database, so that it starts fast, and it dies with its parent.
"""

import ctypes
import importlib
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any, TextIO

PARENT_GONE = 3
"""Exit status after the parent's death; nobody is left to read it."""

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the task that stdin names."""
    _die_with_parent()
    channel = _take_stdout()
    lock = threading.Lock()

    def send(message: dict[str, Any]) -> None:
        # NaN is no JSON: refused here, where the task can still be named, and not by the database
        line = json.dumps(message, allow_nan=False)
        with lock:
            channel.write(line + "\n")
            channel.flush()

    order = json.loads(sys.stdin.readline())
    if os.getppid() != order["parent"]:
        os._exit(PARENT_GONE)  # it died before we asked to be told
    threading.Thread(target=_watch_stdin, daemon=True).start()
    try:
        send(_run(order, send))
    except MemoryError:
        send(_failure(_memory_error(order["task"]), order["task"]))
    except Exception as error:  # noqa: BLE001 - the boundary: whatever it is, the parent must hear
        traceback.print_exc()
        send(_failure(error, order["task"]))
    channel.close()
    os._exit(0)  # a library's stray thread must not keep a finished task alive


def _run(order: dict[str, Any], send: Any) -> dict[str, Any]:
    started = time.perf_counter()
    task = order["task"]
    _limit(task["memory_bytes"], task["cpu_seconds"])
    from prtbake_storage.blobs.opening import open_store
    from prtbake_storage.queue.context import TaskContext

    scratch = Path(order["scratch"])
    store = open_store(order["store_url"], incoming=scratch)
    module, name = task["function"].split(":")
    function = getattr(importlib.import_module(module), name)
    result = function(task["args"], TaskContext(store, scratch, send))
    if not isinstance(result, dict):
        raise TypeError(f"{task['function']} must return a dict, not {type(result).__name__}")
    return {
        "result": result,
        "seconds": time.perf_counter() - started,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def peak_memory_bytes() -> int:
    """Largest resident size of this process since it began its program.

    ``getrusage`` would count the parent's size too, which a child inherits when it is forked.
    """
    for line in (
        Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
    ):
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _memory_error(task: dict[str, Any]) -> MemoryError:
    """Make an error without the frames, and so the arrays, of the one that was raised."""
    if task["memory_bytes"] is None:
        return MemoryError()
    allowed = f"{task['memory_bytes'] / (1 << 30):.3g} GiB"
    return MemoryError(f"{task['label'] or task['function']} needs more than the {allowed} it has")


def _failure(error: BaseException, task: dict[str, Any]) -> dict[str, Any]:
    from prtbake_storage.queue.failures import describe, may_pass

    told = describe(error, limited=task["memory_bytes"] is not None)
    return {"error": told.model_dump(), "retryable": may_pass(error)}


def _die_with_parent() -> None:
    # the kernel kills us when the thread that started us ends; if that thread ended already, or the
    # system is not Linux, the end of stdin tells us
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _watch_stdin() -> None:
    sys.stdin.read()
    os._exit(PARENT_GONE)


def _take_stdout() -> TextIO:
    """Keep stdout for the messages; whatever a library prints goes to stderr."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return channel


def _limit(memory_bytes: int | None, cpu_seconds: int | None) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if memory_bytes is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    if cpu_seconds is not None:
        # with the hard limit equal to the soft one the kernel would send an anonymous SIGKILL
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds + 1))


if __name__ == "__main__":
    main()

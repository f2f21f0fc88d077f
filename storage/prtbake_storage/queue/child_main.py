"""The process that runs one task: ``python -m prtbake_storage.queue.child_main``.

It reads one JSON line on stdin, ``{"task", "package", "store_url", "scratch", "parent"}``, and
writes JSON lines on stdout: ``{"progress": [done, total, unit]}``, ``{"log": {...}}`` and at the
end ``{"result", "seconds", "peak_memory_bytes"}`` or ``{"error", "retryable"}``.  It imports
neither the job engine nor the database, so that it starts fast, and it dies with its parent.
"""

import ctypes
import importlib
import inspect
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from prtbake_storage.queue.context import TaskContext

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
        send(_failure(MemoryError()))
    except Exception as error:  # noqa: BLE001 - the boundary: whatever it is, the parent must hear
        traceback.print_exc()
        send(_failure(error))
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
    function = _find(task["function"], order["package"])
    context = TaskContext(store, scratch, send, settings_at=task["settings_at"])
    result = function(task["args"], context)
    if not isinstance(result, dict):
        raise TypeError(f"{task['function']} must return a dict, not {type(result).__name__}")
    return {
        "result": result,
        "seconds": time.perf_counter() - started,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def _find(path: str, package: str) -> Callable[[dict[str, Any], "TaskContext"], object]:
    """Import the function ``module:name``, which must be one that ``package`` defines itself."""
    module, _, name = path.partition(":")
    # before the import: that runs code too
    if module != package and not module.startswith(f"{package}."):
        raise ValueError(f"{path} is no task: it does not lie in {package}")
    function = getattr(importlib.import_module(module), name)
    if not inspect.isfunction(function) or function.__module__ != module:
        raise ValueError(f"{path} is no task: it is not a function that {module} defines")
    return function


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


def _failure(error: BaseException) -> dict[str, Any]:
    from prtbake_storage.queue.failures import describe, may_pass

    return {"error": describe(error).model_dump(), "retryable": may_pass(error)}


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

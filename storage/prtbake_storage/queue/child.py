"""Run a task in a child process, and end it when asked to."""

import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from prtbake_storage.contract.jobs import JobError
from prtbake_storage.queue.failures import (
    CPU_LIMIT,
    OUT_OF_MEMORY,
    TaskFailed,
    TaskStopped,
    over_limit,
)
from prtbake_storage.queue.memo import Memory
from prtbake_storage.queue.stages import Measured, Task

_log = logging.getLogger(__name__)

STDERR_LINES = 20
"""Last lines of a dead task's stderr that go into its error."""

_KEPT = frozenset({
    "PATH", "HOME", "USER", "LOGNAME", "TZ", "LANG", "LANGUAGE", "VIRTUAL_ENV",
    "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH",
})  # fmt: skip
_KEPT_FAMILIES = (
    "LC_", "XDG_", "PYTHON", "OMP_", "OPENBLAS_", "MKL_", "KMP_", "NUMBA_",
    "EGL_", "__EGL_", "__GLX_", "LIBGL_", "MESA_", "GALLIUM_", "LP_", "CUDA_", "NVIDIA_",
)  # fmt: skip
"""What a task is given of our environment: what Python and its libraries are set up with.

A task reads files from outside: no password of ours, nor of what else runs here, is its business.
"""

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def run_task_in_child(
    task: Task,
    *,
    package: str,
    store_url: str,
    scratch: Path,
    on_message: Callable[[dict[str, Any]], None],
    should_stop: Callable[[], str | None],
    check_s: float = 0.5,
) -> Memory:
    """Run a task to its end, in a group of processes that cannot outlive this call.

    Parameters
    ----------
    task
        What to run.
    package
        Where its function must be defined.
    store_url, scratch
        Where its blobs are; an empty folder that the caller removes.
    on_message
        Called in this thread with each ``{"progress": ...}`` and ``{"log": ...}``.
    should_stop
        Asked every ``check_s`` seconds; a reason stops the task at once.

    Returns
    -------
    Memory
        Result and costs.

    Raises
    ------
    TaskStopped
        ``should_stop`` gave a reason.
    TaskFailed
        The task reported an error, or its process died.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "prtbake_storage.queue.child_main"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=child_environment(task.threads, scratch),
        start_new_session=True,  # a group of its own: one kill reaches all of it
    )
    if process.stdin is None or process.stdout is None or process.stderr is None:
        raise RuntimeError("a child without pipes")
    messages: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    tail: deque[str] = deque(maxlen=STDERR_LINES)
    readers = [
        threading.Thread(target=_read_messages, args=(process.stdout, messages), daemon=True),
        threading.Thread(target=_read_stderr, args=(process.stderr, tail, task), daemon=True),
    ]
    for reader in readers:
        reader.start()
    answer: dict[str, Any] = {}
    try:
        order = {
            "task": task.to_dict(),
            "package": package,
            "store_url": store_url,
            "scratch": str(scratch),
            "parent": os.getpid(),
        }
        _send_order(process.stdin, order)
        next_check = time.monotonic() + check_s
        while True:
            try:
                message = messages.get(timeout=max(0.0, next_check - time.monotonic()))
            except queue.Empty:
                message = {}
            if message is None:
                _await_end(process)
                break
            if "result" in message or "error" in message:
                answer = message  # its last word
                break
            if message:
                on_message(message)
            if time.monotonic() >= next_check:
                next_check = time.monotonic() + check_s
                if process.poll() is not None:
                    _kill_group(process)  # what it left behind may hold its stdout open
                if (reason := should_stop()) is not None:
                    raise TaskStopped(reason)
    finally:
        # whatever was raised above, nothing of the task may live on
        _kill_group(process)
        process.wait()
        process.stdin.close()
        for reader in readers:  # who left the group may hold a pipe: its reader waits, we do not
            reader.join(timeout=1.0)
    return _outcome(answer, process.returncode, tail, task)


def child_environment(threads: int, scratch: Path) -> dict[str, str]:
    """Environment of a task: threads, temporary folder, a fixed hash seed, and no secrets."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name in _KEPT or name.startswith(_KEPT_FAMILIES)
    }
    environment |= {name: str(threads) for name in _THREAD_VARIABLES}
    environment |= {"TMPDIR": str(scratch), "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1"}
    return environment


def _outcome(answer: dict[str, Any], status: int, tail: deque[str], task: Task) -> Memory:
    if "result" in answer:
        return Memory(answer["result"], Measured(answer["seconds"], answer["peak_memory_bytes"]))
    if "error" in answer:
        error = JobError.model_validate(answer["error"])
        if error.code == OUT_OF_MEMORY and task.memory_bytes is not None:
            detail = f"{task.title} needs more than {task.memory_bytes / 2**30:g} GiB of memory"
            raise TaskFailed(over_limit(OUT_OF_MEMORY, detail))
        raise TaskFailed(error, retryable=answer["retryable"])
    last = tail[-1] if tail else "it left no message"
    if status == -signal.SIGXCPU:
        detail = f"{task.title} needs more than {task.cpu_seconds} s of CPU time"
        raise TaskFailed(over_limit(CPU_LIMIT, detail))
    how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"exited with {status}"
    detail = f"the process of {task.title} {how}: {last}"
    # a signal is the system's doing (out of memory, a crash in native code): it may pass
    error = JobError(kind="resource", code="task-died", detail=detail)
    raise TaskFailed(error, retryable=status < 0)


def _send_order(stdin: IO[str], order: dict[str, Any]) -> None:
    try:
        stdin.write(json.dumps(order) + "\n")
        stdin.flush()  # and it stays open: its end tells the child that we are gone
    except BrokenPipeError:
        return  # it died already: its exit status says why


def _read_messages(stdout: IO[str], messages: "queue.SimpleQueue[dict[str, Any] | None]") -> None:
    try:
        with stdout:
            for line in stdout:
                messages.put(json.loads(line))
    except ValueError:  # a line cut short by the child's death
        pass
    finally:
        messages.put(None)


def _read_stderr(stderr: IO[str], tail: deque[str], task: Task) -> None:
    with stderr:
        for line in stderr:
            text = line.rstrip()
            tail.append(text)
            _log.info("task.stderr", extra={"line": text, "task": task.title})


def _await_end(process: subprocess.Popen[str]) -> None:
    """Wait for a child that has closed its stdout, so that its exit status is its own."""
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        return


def _kill_group(process: subprocess.Popen[str]) -> None:
    """Kill a task and what it started, also after its own end."""
    # as long as anybody is in the group, the system gives its number to nobody else
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)

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
from pathlib import Path
from typing import IO, Any

from prtbake_storage.contract.jobs import JobError
from prtbake_storage.queue.failures import TaskFailed, TaskStopped
from prtbake_storage.queue.memo import Memory
from prtbake_storage.queue.stages import Measured, Task

_log = logging.getLogger(__name__)

STDERR_LINES = 20
"""Last lines of a dead task's stderr that go into its error."""

_SECRETS = frozenset({"PRTBAKE_DATABASE_URL", "PRTBAKE_API_KEY"})
"""A task reads files from outside; neither the database nor the API is its business."""

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
    store_url: str,
    scratch: Path,
    on_message: Callable[[dict[str, Any]], None],
    should_stop: Callable[[], str | None],
    check_s: float = 0.5,
) -> Memory:
    """Run a task to its end, in a process that cannot outlive this call.

    Parameters
    ----------
    task
        What to run.
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
                answer = message
            elif message:
                on_message(message)
            if time.monotonic() >= next_check:
                next_check = time.monotonic() + check_s
                if (reason := should_stop()) is not None:
                    raise TaskStopped(reason)
    finally:
        # whatever was raised above, nothing of the task may live on
        _kill(process)
        for reader in readers:
            reader.join(timeout=1.0)
        process.stdin.close()
        process.stdout.close()
        process.stderr.close()
    return _outcome(answer, process.returncode, tail, task)


def child_environment(threads: int, scratch: Path) -> dict[str, str]:
    """Environment of a task: threads, temporary folder, a fixed hash seed, and no secrets."""
    environment = {name: value for name, value in os.environ.items() if name not in _SECRETS}
    environment |= {name: str(threads) for name in _THREAD_VARIABLES}
    environment |= {"TMPDIR": str(scratch), "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1"}
    return environment


def _outcome(answer: dict[str, Any], status: int, tail: deque[str], task: Task) -> Memory:
    if "result" in answer:
        return Memory(answer["result"], Measured(answer["seconds"], answer["peak_memory_bytes"]))
    if "error" in answer:
        raise TaskFailed(JobError.model_validate(answer["error"]), retryable=answer["retryable"])
    last = tail[-1] if tail else "it left no message"
    if status == -signal.SIGXCPU:
        detail = f"{task.title} used more than {task.cpu_seconds} s of CPU time"
        raise TaskFailed(JobError(kind="resource", code="cpu-limit", detail=detail))
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
        for line in stdout:
            messages.put(json.loads(line))
    except ValueError:  # a line cut short by the child's death, or the pipe closed under us
        pass
    finally:
        messages.put(None)


def _read_stderr(stderr: IO[str], tail: deque[str], task: Task) -> None:
    try:
        for line in stderr:
            text = line.rstrip()
            tail.append(text)
            _log.info("task.stderr", extra={"line": text, "task": task.title})
    except ValueError:  # the pipe closed under us
        return


def _await_end(process: subprocess.Popen[str]) -> None:
    """Wait for a child that has closed its stdout, so that its exit status is its own."""
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        return


def _kill(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            process.kill()
    process.wait()

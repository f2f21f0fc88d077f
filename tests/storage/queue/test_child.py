"""The child process: its surroundings, its ends, and that it never lives on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.queue.child import run_task_in_child
from prtbake_storage.queue.failures import TaskFailed, TaskStopped
from prtbake_storage.queue.memo import Memory
from prtbake_storage.queue.stages import Task

HERE = str(Path(__file__).parent)
Run = Callable[..., Memory]


@pytest.fixture
def messages() -> list[dict[str, Any]]:
    """What the child sent."""
    return []


@pytest.fixture
def run(tmp_path: Path, messages: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a task of `child_tasks`."""
    monkeypatch.setenv("PYTHONPATH", HERE, prepend=os.pathsep)
    store = LocalBlobStore(tmp_path / "store")

    def run(
        name: str,
        args: Any,
        stop: Callable[[], str | None] = lambda: None,
        package: str = "child_tasks",
        **limits: int,
    ) -> Memory:
        with store.scratch() as scratch:
            return run_task_in_child(
                Task(name if ":" in name else f"child_tasks:{name}", args, **limits),
                package=package,
                store_url=store.url,
                scratch=scratch,
                on_message=messages.append,
                should_stop=stop,
                check_s=0.1,
            )

    return run


def await_death(pid: int) -> None:
    """Wait until a process is gone, or only its entry is left."""
    until = time.monotonic() + 20.0
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < until, f"process {pid} lives on"
        time.sleep(0.02)


def test_a_task_finds_its_threads_its_folder_and_its_store(run: Run, tmp_path: Path) -> None:
    memory = run("surroundings", {"x": [1, "é"]}, threads=3)
    found = memory.result
    assert found["args"] == {"x": [1, "é"]}
    assert (found["threads"], found["hash_seed"]) == ("3", "0")
    assert found["temporary"].startswith(str(tmp_path / "store" / "scratch"))
    assert found["heavy"] == []  # it must start fast, and know neither engine nor database
    assert LocalBlobStore(tmp_path / "store").read_bytes(found["digest"]) == b"from the child"
    assert memory.measured.seconds > 0.0
    assert 1e6 < memory.measured.peak_memory_bytes < 1e9
    assert list((tmp_path / "store" / "scratch").iterdir()) == []


def test_only_the_tasks_own_words_count(run: Run, messages: list[dict[str, Any]]) -> None:
    assert run("chatter", {}).result == {"fine": True}
    assert {"log": {"message": "half way", "n": 1}} in messages
    progress = [message["progress"] for message in messages if "progress" in message]
    assert progress[-1] == [1000.0, 1000.0, "rows"]
    assert len(progress) < 10  # of 1001 calls: people cannot read more


@pytest.mark.parametrize(
    ("how", "kind", "code", "detail", "retryable"),
    [
        ("mesh", "input", "invalid-mesh", "vertex 7 is NaN", False),
        ("bug", "internal", "internal", "KeyError: 'missing'", False),
        ("no-dict", "internal", "internal", "must return a dict, not list", False),
        ("nan", "internal", "internal", "JSON compliant", False),
        ("no-memory", "resource", "out-of-memory", "ran out of memory", False),
        ("eio", "resource", "io-error", "OSError: [Errno 5] Input/output error", True),
        ("segfault", "resource", "task-died", "SIGSEGV", True),
        ("exit", "resource", "task-died", "exited with 7: giving up", False),
    ],
)
def test_an_end_without_result_is_told_by_kind(
    run: Run, how: str, kind: str, code: str, detail: str, *, retryable: bool
) -> None:
    with pytest.raises(TaskFailed) as caught:
        run("fail", {"how": how})
    error = caught.value.error
    assert (error.kind, error.code, caught.value.retryable) == (kind, code, retryable)
    assert detail in error.detail
    assert error.pointer == ("/blob" if how == "mesh" else None)


def test_memory_and_time_are_limited_and_what_exceeds_them_is_the_inputs_fault(run: Run) -> None:
    with pytest.raises(TaskFailed) as caught:
        run("fail", {"how": "memory"}, memory_bytes=1 << 30)
    assert (caught.value.error.kind, caught.value.error.code) == ("input", "out-of-memory")
    assert caught.value.error.detail == "child_tasks:fail needs more than 1 GiB of memory"
    assert not caught.value.retryable
    with pytest.raises(TaskFailed) as caught:
        run("fail", {"how": "cpu"}, cpu_seconds=1)
    assert (caught.value.error.kind, caught.value.error.code) == ("input", "cpu-limit")
    assert caught.value.error.detail == "child_tasks:fail needs more than 1 s of CPU time"


def test_a_module_that_is_not_there_is_an_error_and_no_hang(run: Run) -> None:
    with pytest.raises(TaskFailed, match="no_such"):
        run("no_such", {})


@pytest.mark.parametrize(
    ("function", "package", "refused"),
    [
        ("cProfile:run", "child_tasks", "cProfile:run is no task"),
        ("cProfile:run", "cProf", "cProfile:run is no task"),
        ("child_tasks:profile", "child_tasks", "is not a function that child_tasks defines"),
        ("child_tasks:Task", "child_tasks", "is not a function that child_tasks defines"),
        ("cProfile:run", "cProfile", ""),  # the trap is sound
    ],
)
def test_a_task_names_a_function_that_its_package_defines(
    run: Run, tmp_path: Path, function: str, package: str, refused: str
) -> None:
    trap = tmp_path / "trap"
    with pytest.raises(TaskFailed, match=refused or None) as caught:
        run(function, f"__import__('os').mkdir({str(trap)!r})", package=package)
    assert (caught.value.error.kind, caught.value.retryable) == ("internal", False)
    assert trap.exists() == (not refused)


def test_a_stray_thread_does_not_keep_a_finished_task(run: Run) -> None:
    assert run("stray_thread", {}).result == {"fine": True}


def test_stopping_kills_the_task_and_what_it_started(
    run: Run, messages: list[dict[str, Any]], tmp_path: Path
) -> None:
    with pytest.raises(TaskStopped) as caught:
        run("hang", {}, lambda: "canceled" if messages else None)
    assert caught.value.reason == "canceled"
    for pid in (messages[0]["log"]["own"], messages[0]["log"]["helper"]):
        await_death(pid)
    assert list((tmp_path / "store" / "scratch").iterdir()) == []


@pytest.mark.parametrize("how", ["fork", "subprocess", "session"])
def test_what_a_task_leaves_behind_does_not_hold_its_worker(
    run: Run, messages: list[dict[str, Any]], how: str
) -> None:
    begin = time.monotonic()
    assert run("leave", {"how": how}).result == {"fine": True}
    assert time.monotonic() - begin < 10.0
    left = messages[0]["log"]["pid"]
    if how == "session":  # out of our reach, and out of our way
        os.kill(left, signal.SIGKILL)
    await_death(left)


def test_a_death_is_seen_through_what_holds_its_pipes(
    run: Run, messages: list[dict[str, Any]]
) -> None:
    begin = time.monotonic()
    with pytest.raises(TaskFailed, match="SIGKILL"):
        run("leave", {"how": "fork-and-die"})
    assert time.monotonic() - begin < 10.0
    await_death(messages[0]["log"]["pid"])


def test_a_task_is_told_no_secrets(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    secrets = ("PRTBAKE_DATABASE_URL", "PRTBAKE_API_KEY", "PGPASSWORD", "AWS_SECRET_ACCESS_KEY")
    for name in secrets:
        monkeypatch.setenv(name, "secret")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/tmp")
    found = set(run("surroundings", {}).result["environment"])
    assert found.isdisjoint(secrets)
    assert {"PATH", "NUMBA_CACHE_DIR", "OMP_NUM_THREADS"} <= found


READING_ITS_PARENT = """
import ctypes, os, sys
from prtbake_storage.queue.privacy import forbid_reading

if os.geteuid() == 0:  # root reads everything
    os.setgid(65534)
    os.setuid(65534)
ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)  # as every process is after its exec
if sys.argv[1] == "closed":
    forbid_reading()
if os.fork() == 0:
    try:
        open(f"/proc/{os.getppid()}/environ", "rb").read()
    except PermissionError:
        os._exit(3)
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""


@pytest.mark.parametrize(("how", "status"), [("open", 0), ("closed", 3)])
def test_a_child_cannot_read_the_secrets_of_its_parent(how: str, status: int) -> None:
    done = subprocess.run([sys.executable, "-c", READING_ITS_PARENT, how], check=False)
    assert done.returncode == status


def test_an_error_in_the_callback_kills_the_task(run: Run, messages: list[dict[str, Any]]) -> None:
    def break_down() -> None:
        if messages:
            raise ConnectionError("the database is away")

    with pytest.raises(ConnectionError):
        run("hang", {}, break_down)
    await_death(messages[0]["log"]["own"])


def test_a_task_dies_with_a_parent_that_was_killed(tmp_path: Path) -> None:
    code = (
        "import json, sys; from pathlib import Path\n"
        "from prtbake_storage.queue.child import run_task_in_child\n"
        "from prtbake_storage.queue.stages import Task\n"
        "say = lambda message: print(json.dumps(message), flush=True)\n"
        "run_task_in_child(Task('child_tasks:hang', {}), package='child_tasks', store_url=sys.argv[1],\n"
        "    scratch=Path(sys.argv[1]), on_message=say, should_stop=lambda: None)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([HERE, *sys.path])},
    )
    assert parent.stdout is not None
    pids = json.loads(parent.stdout.readline())["log"]
    try:
        parent.kill()
        parent.wait()
        await_death(pids["own"])
    finally:
        parent.stdout.close()
        os.kill(pids["helper"], signal.SIGKILL)

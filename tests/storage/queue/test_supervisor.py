"""The supervisor of real workers: starts that fail, and its own end."""

import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from prtbake_storage.queue import supervisor as supervisor_module
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.supervisor import Supervisor

CRASHING = """
import sys
from prtbake_storage.queue import worker_main
from prtbake_storage.queue.supervisor import Supervisor

look_after = Supervisor._look_after

def break_down(self, place):
    if place.process is not None:
        raise RuntimeError(f"a bug; left alone: {place.process.pid}")
    look_after(self, place)

Supervisor._look_after = break_down
worker_main.main(["--workers", "1"])
"""


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_start_that_fails_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    supervisor = Supervisor(2, QueueSettings(data_dir=tmp_path))
    with monkeypatch.context() as patch:
        # as a fork fails that the system has no process left for
        patch.setattr(supervisor_module.sys, "executable", str(tmp_path / "nothing"))
        supervisor.start()
        until(lambda: caplog.messages.count("worker.start_failed") >= 2)
        assert supervisor.workers == {}
    until(lambda: len(supervisor.workers) == 2)
    assert not supervisor.failed
    supervisor.stop()
    assert supervisor.workers == {}
    assert caplog.messages.count("worker.start_failed") <= 4  # it waits between two tries


def test_a_process_ends_with_its_supervising_thread(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CRASHING],
        env=QueueSettings(data_dir=tmp_path).to_env() | {"PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        timeout=30.0,
        check=False,
    )
    assert done.returncode == 1
    assert "supervisor.crashed" in done.stderr
    worker = int(re.findall(r"left alone: (\d+)", done.stderr)[0])
    assert not psutil.pid_exists(worker)

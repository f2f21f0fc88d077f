"""Start N workers, keep them running, and say at once when one has died."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from types import TracebackType

from prtbake_storage.queue.settings import REGISTRY, QueueSettings, new_executor_id
from prtbake_storage.records.database import Database, create_database
from prtbake_storage.records.workers import Workers

_log = logging.getLogger(__name__)

LOOK_S = 0.1
QUICK_DEATH_S = 5.0
"""A worker that dies sooner than this after its start probably cannot run: the next one waits."""
LONGEST_WAIT_S = 30.0
LEAVE_S = 15.0


@dataclass
class _Place:
    """One of the N: its process, or when the next one may start."""

    executor_id: str
    process: subprocess.Popen[bytes] | None
    started: float
    failures: int = 0
    not_before: float = 0.0


class Supervisor:
    """Runs worker processes; used as a context, or with `start` and `stop`.

    Parameters
    ----------
    n_workers
        How many.
    settings
        Passed to them through the environment.
    registry
        ``module:attribute`` of the job kinds.
    environment
        More variables for them.
    """

    def __init__(
        self,
        n_workers: int,
        settings: QueueSettings,
        *,
        registry: str = REGISTRY,
        environment: dict[str, str] | None = None,
    ) -> None:
        self._settings, self._registry = settings, registry
        self._environment = {**os.environ, **settings.to_env(), **(environment or {})}
        self._places = [_Place("", None, 0.0) for _ in range(n_workers)]
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)
        self._database: Database | None = None

    def start(self) -> "Supervisor":
        """Start the workers."""
        self._database = create_database(self._settings.database_url)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Ask the workers to leave, and kill those that have not after `LEAVE_S`."""
        self._stop.set()
        self._thread.join(timeout=2 * LEAVE_S)
        if self._database is not None:
            self._database.dispose()

    @property
    def workers(self) -> dict[str, int]:
        """Process ids of the workers by executor id."""
        with self._lock:
            return {
                place.executor_id: place.process.pid
                for place in self._places
                if place.process is not None
            }

    @property
    def failed(self) -> bool:
        """Whether supervision ended unasked: nobody looks after the workers any more."""
        return not self._thread.is_alive() and not self._stop.is_set()

    def __enter__(self) -> "Supervisor":
        return self.start()

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def _run(self) -> None:
        # workers are told when the thread that started them ends, so this one starts them all
        try:
            while not self._stop.is_set():
                for place in self._places:
                    self._look_after(place)
                self._stop.wait(LOOK_S)
        except Exception:  # noqa: BLE001 - logged whole, and `failed` tells whoever waits
            _log.exception("supervisor.crashed")
        finally:
            self._end_all()

    def _look_after(self, place: _Place) -> None:
        now = time.monotonic()
        if place.process is not None:
            status = place.process.poll()
            if status is None:
                return
            _log.warning("worker.died", extra={"worker": place.executor_id, "status": status})
            self._mark_gone(place.executor_id)
            self._put_off(place, quick=now - place.started < QUICK_DEATH_S)
            with self._lock:
                place.process = None
        if now >= place.not_before:
            executor_id = new_executor_id()
            try:
                process = self._spawn(executor_id)
            except OSError as error:  # no process, memory or handle is left: that may pass
                _log.warning("worker.start_failed", extra={"error": str(error)[:200]})
                self._put_off(place, quick=True)
                return
            with self._lock:
                place.executor_id, place.process, place.started = executor_id, process, now

    @staticmethod
    def _put_off(place: _Place, *, quick: bool) -> None:
        """Say when the next worker may start: after a ``quick`` end later each time."""
        place.failures = place.failures + 1 if quick else 0
        place.not_before = time.monotonic()
        if place.failures:
            # the exponent is bounded too: a float overflows at 1024 failures
            place.not_before += min(LONGEST_WAIT_S, 2.0 ** min(place.failures - 1, 10))

    def _spawn(self, executor_id: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [
                sys.executable, "-m", "prtbake_storage.queue.worker_main",
                "--registry", self._registry,
                "--executor-id", executor_id,
                "--parent", str(os.getpid()),
            ],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches us, and we pass it on in good order
        )  # fmt: skip

    def _mark_gone(self, executor_id: str) -> None:
        try:
            if self._database is not None:
                Workers(self._database).mark_gone(executor_id)
        except Exception as error:  # noqa: BLE001 - its silence will tell, a little later
            _log.warning("worker.mark_failed", extra={"error": str(error)[:200]})

    def _end_all(self) -> None:
        processes = [place.process for place in self._places if place.process is not None]
        for process in processes:
            process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + LEAVE_S
        for process in processes:
            try:
                process.wait(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        with self._lock:
            for place in self._places:
                place.process = None

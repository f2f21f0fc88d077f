"""A service and its workers on this machine: processes, one data directory, the loopback.

The SDK does not import the service: it starts ``python -m`` of what the ``server`` and ``workers``
extras install.
"""

import ctypes
import fcntl
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import httpx

from prtbake.config import SERVER_FILE, START_S, read_key, read_server, write_server
from prtbake.errors import LaunchError

STOP_S = 20.0
"""Workers hand their tiles back and leave within 15 s, or are killed by their supervisor."""
LOG_LINES = 8
STORAGE_VARIABLES = ("PRTBAKE_DATABASE_URL", "PRTBAKE_BLOB_URL")
LOCK_FILE = "serve.lock"
_PR_SET_PDEATHSIG = 1


class LocalService:
    """Start with ``with``; everything is stopped at the end, however it comes.

    Parameters
    ----------
    data_dir
        Home of database, blobs, API key and logs; made if it is not there.
    n_workers
        Worker processes.
    host, port
        Where to listen; port 0 takes a free one.
    verbose
        Leave the logs on this terminal rather than in ``logs/``.
    embedded
        Keep database and blobs in ``data_dir`` whatever the environment says: for a directory that
        will be removed, whose blobs a database elsewhere would go on referring to.

    Raises
    ------
    LaunchError
        When another service runs on the directory, the port is taken, or a process ends early.
    """

    def __init__(
        self,
        data_dir: Path,
        *,
        n_workers: int = 2,
        host: str = "127.0.0.1",
        port: int = 0,
        verbose: bool = False,
        embedded: bool = False,
    ) -> None:
        self.data_dir = data_dir
        self.n_workers = n_workers
        self.url = ""
        self._host = host
        self._port = port
        self._verbose = verbose
        self._embedded = embedded
        self._lock: IO[str] | None = None
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def key(self) -> str | None:
        """The API key that the service generated."""
        return os.environ.get("PRTBAKE_API_KEY") or read_key(self.data_dir)

    @property
    def page(self) -> str:
        """The page's address with the key in its fragment, which browsers do not send."""
        return f"{self.url}/#key={self.key}" if self.key else self.url

    def __enter__(self) -> Self:
        if importlib.util.find_spec("prtbake_service") is None:
            raise LaunchError("the service is not installed: pip install 'prtbake[workers]'")
        self.data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._take_lock()
        try:
            with self._listen() as listener:
                # the port takes connections from now on: clients must know that it is too early
                write_server(self.data_dir, self.url, ready=False)
                self._start(listener)
            self._await_ready()
            write_server(self.data_dir, self.url, ready=True)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def ended(self) -> str | None:
        """Return the name of a process that has ended by itself, or None."""
        for name, process in self._processes.items():
            if process.poll() is not None:
                return name
        return None

    def run(self) -> None:
        """Wait until a signal interrupts; a process that ends by itself is a `LaunchError`."""
        while (name := self.ended()) is None:
            time.sleep(0.5)
        raise self._early_end(name)

    def stop(self) -> None:
        """Ask all processes to leave, and kill those that do not."""
        (self.data_dir / SERVER_FILE).unlink(missing_ok=True)
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + STOP_S
        for process in self._processes.values():
            try:
                process.wait(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _take_lock(self) -> None:
        lock = (self.data_dir / LOCK_FILE).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            server = read_server(self.data_dir)
            at = f" at {server.url}" if server else ""
            raise LaunchError(f"a service runs on {self.data_dir} already{at}") from None
        self._lock = lock

    def _listen(self) -> socket.socket:
        # bound here: a port that is taken is reported at once, and none is lost to a race
        try:
            listener = socket.create_server((self._host, self._port))
        except OSError as error:
            raise LaunchError(f"cannot listen on {self._host}:{self._port}: {error}") from error
        self.url = f"http://{self._host}:{listener.getsockname()[1]}"
        return listener

    def _start(self, listener: socket.socket) -> None:
        environment = os.environ | {"PRTBAKE_DATA_DIR": str(self.data_dir)}
        for name in ("PRTBAKE_FD", *(STORAGE_VARIABLES if self._embedded else ())):
            environment.pop(name, None)
        handle = listener.fileno()
        self._processes["service"] = self._spawn(
            "service",
            ["-m", "prtbake_service.main"],
            environment | {"PRTBAKE_FD": str(handle)},
            (handle,),
        )
        self._processes["workers"] = self._spawn(
            "workers",
            ["-m", "prtbake_storage.queue.worker_main", "--workers", str(self.n_workers)],
            environment,
            (),
        )

    def _spawn(
        self, name: str, arguments: list[str], environment: dict[str, str], handles: tuple[int, ...]
    ) -> subprocess.Popen[bytes]:
        log: IO[bytes] | None = None
        if not self._verbose:
            path = self._log(name)
            path.parent.mkdir(exist_ok=True)
            log = path.open("ab")
        try:
            return subprocess.Popen(
                [sys.executable, *arguments],
                env=environment,
                pass_fds=handles,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C comes to us alone, and we stop the others in order
                start_new_session=True,
                preexec_fn=_die_with_parent if sys.platform == "linux" else None,
            )
        finally:
            if log is not None:
                log.close()

    def _await_ready(self) -> None:
        deadline = time.monotonic() + START_S
        with httpx.Client(base_url=self.url, timeout=2.0, trust_env=False) as http:
            while time.monotonic() < deadline:
                if (name := self.ended()) is not None:
                    raise self._early_end(name)
                try:
                    answer = http.get("/readyz")
                    # a service whose workers die at their start would wait for ever
                    if answer.status_code == 200 and answer.json()["workers"] > 0:
                        return
                except httpx.TransportError:
                    pass
                time.sleep(0.1)
        raise LaunchError(
            f"service and workers were not ready after {START_S:.0f} s; see {self._where()}"
            + self._tail("workers")
        )

    def _early_end(self, name: str) -> LaunchError:
        code = self._processes[name].returncode
        return LaunchError(
            f"the {name} ended with status {code}; see {self._where()}{self._tail(name)}"
        )

    def _tail(self, name: str) -> str:
        if self._verbose or not self._log(name).exists():
            return ""
        lines = self._log(name).read_text(errors="replace").splitlines()[-LOG_LINES:]
        return "".join(f"\n  {line}" for line in lines)

    def _where(self) -> str:
        return "above" if self._verbose else str(self.data_dir / "logs")

    def _log(self, name: str) -> Path:
        return self.data_dir / "logs" / f"{name}.log"


def _die_with_parent() -> None:
    # kill -9 of this process must not leave a service behind
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

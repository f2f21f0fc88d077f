"""Where the service is and which key opens it."""

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

from prtbake.errors import ServiceUnreachable

HOME_VARIABLE = "PRTBAKE_HOME"
URL_VARIABLE = "PRTBAKE_URL"
KEY_VARIABLE = "PRTBAKE_API_KEY"
SERVER_FILE = "server.json"
KEY_FILE = "api-key"
DEFAULT_URL = "http://127.0.0.1:8420"
START_S = 60.0
"""A cold start imports the engine and migrates the database: 3 s on a quiet machine."""
GRACE_S = 2.0
"""A shell starts `prtbake serve &` and the next line at once, and Python takes a second."""
POLL_S = 0.05


@dataclass(frozen=True)
class Endpoint:
    """A service: its base URL and an API key for it (None to go without)."""

    url: str
    key: str | None = None


def home(data_dir: Path | None = None) -> Path:
    """Return the data directory of the local service.

    The argument wins, then ``PRTBAKE_HOME``, then the platform's place for user data.
    """
    if data_dir is not None:
        return data_dir.expanduser().resolve()
    if set_by_user := os.environ.get(HOME_VARIABLE):
        return Path(set_by_user).expanduser().resolve()
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "prtbake"


@dataclass(frozen=True)
class LocalServer:
    """What `prtbake serve` says of itself in its data directory."""

    url: str
    pid: int
    ready: bool


def discover(
    url: str | None = None,
    key: str | None = None,
    data_dir: Path | None = None,
    *,
    grace_s: float = GRACE_S,
    start_s: float = START_S,
) -> Endpoint:
    """Find the service: arguments first, then the environment, then a local ``prtbake serve``.

    A local service that is starting is waited for.

    Parameters
    ----------
    grace_s
        How long to look for a local service before there is said to be none.
    start_s
        How long to wait for one that is starting.

    Raises
    ------
    ServiceUnreachable
        When none is named and none runs here, or it is not ready in time.

    Notes
    -----
    The local key is taken for the local service only: a key never goes to a URL that it was not
    written for.
    """
    folder = home(data_dir)
    # a data directory named by hand means the service that runs on it
    named = url or (None if data_dir else os.environ.get(URL_VARIABLE))
    given = key or os.environ.get(KEY_VARIABLE)
    if named is not None:
        local = read_server(folder) if given is None else None
        return Endpoint(named, read_key(folder) if local and local.url == named else given)
    # whoever has a key may mean a service that this machine knows nothing of
    server = _await_server(folder, 0.0 if given else grace_s, start_s)
    if server is not None:
        return Endpoint(server.url, given or read_key(folder))
    if given is not None:
        return Endpoint(DEFAULT_URL, given)
    raise ServiceUnreachable(
        f"no service runs on {folder}: start one with `prtbake serve`,"
        f" or name another with {URL_VARIABLE}"
    )


def _await_server(folder: Path, grace_s: float, start_s: float) -> LocalServer | None:
    began = time.monotonic()
    while True:
        server = read_server(folder)
        waited = time.monotonic() - began
        if server is None:
            if waited >= grace_s:
                return None
        elif server.ready:
            return server
        elif waited >= start_s:
            raise ServiceUnreachable(
                f"the service on {folder} is starting; after {start_s:g} s it is not ready yet"
            )
        time.sleep(POLL_S)


def read_server(folder: Path) -> LocalServer | None:
    """Return what runs on a data directory, or None: a killed launcher leaves its record behind."""
    try:
        record = json.loads((folder / SERVER_FILE).read_text())
        server = LocalServer(str(record["url"]), int(record["pid"]), record["state"] == "ready")
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return server if _is_alive(server.pid) else None


def write_server(folder: Path, url: str, *, ready: bool) -> None:
    """Say what this process runs on a data directory; readers see the whole record or none."""
    record = {"url": url, "pid": os.getpid(), "state": "ready" if ready else "starting"}
    temporary = folder / f".{SERVER_FILE}.{os.getpid()}"
    temporary.write_text(json.dumps(record))
    temporary.replace(folder / SERVER_FILE)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True


def read_key(folder: Path) -> str | None:
    """Return the API key that the service generated in a data directory, or None."""
    try:
        return (folder / KEY_FILE).read_text().strip() or None
    except OSError:
        return None

"""Where the service is and which key opens it."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

HOME_VARIABLE = "PRTBAKE_HOME"
URL_VARIABLE = "PRTBAKE_URL"
KEY_VARIABLE = "PRTBAKE_API_KEY"
SERVER_FILE = "server.json"
KEY_FILE = "api-key"
DEFAULT_URL = "http://127.0.0.1:8420"


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


def discover(
    url: str | None = None, key: str | None = None, data_dir: Path | None = None
) -> Endpoint:
    """Find the service: arguments first, then the environment, then a local ``prtbake serve``.

    Notes
    -----
    The local key is taken for the local service only: a key never goes to a URL that it was not
    written for.
    """
    folder = home(data_dir)
    local_url = read_server_url(folder)
    # a data directory named by hand means the service that runs on it
    found = url or (None if data_dir else os.environ.get(URL_VARIABLE)) or local_url or DEFAULT_URL
    given = key or os.environ.get(KEY_VARIABLE)
    if given is None and found == local_url:
        given = read_key(folder)
    return Endpoint(found, given)


def read_server_url(folder: Path) -> str | None:
    """Return the URL of the service that runs on a data directory, or None."""
    try:
        record = json.loads((folder / SERVER_FILE).read_text())
    except (OSError, ValueError):
        return None
    url = record.get("url") if isinstance(record, dict) else None
    return url if isinstance(url, str) else None


def read_key(folder: Path) -> str | None:
    """Return the API key that the service generated in a data directory, or None."""
    try:
        return (folder / KEY_FILE).read_text().strip() or None
    except OSError:
        return None

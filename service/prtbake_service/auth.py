"""Who may call: bearer API keys, stored hashed, each scoped to a project."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from fastapi import Depends
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from prtbake_service.backend import Backend, BackendDep
from prtbake_storage.errors import Unauthorised
from prtbake_storage.records import Key
from prtbake_storage.records.keys import new_secret

KEY_FILE = "api-key"
_bearer = HTTPBearer(auto_error=False, description="an API key of prtbake")


def authenticate(
    backend: BackendDep,
    credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Key:
    """Return the key that a request carries, or refuse the request."""
    if credentials is None:
        raise Unauthorised("send the header 'Authorization: Bearer <API key>'")
    key = backend.keys.verify(credentials.credentials)
    if key is None:
        raise Unauthorised("the API key is not known here, or was revoked")
    return key


Caller = Annotated[Key, Depends(authenticate)]


def ensure_key(backend: Backend) -> None:
    """Make sure that somebody can call: the operator's key, or one made at the first start.

    The generated key lies in the data directory, readable by its owner only.  A database that is
    new beside an old data directory takes over the key that lies there.  A key that was given or
    lay there at an earlier start, and is another now, is closed; so is one whose file was removed.
    """
    settings = backend.settings
    if settings.api_key is not None:
        backend.keys.replace(settings.api_key.get_secret_value(), label="given by the operator")
        return
    path = settings.data_dir / KEY_FILE
    secret = path.read_text().strip() if path.exists() else ""
    if not secret or backend.keys.is_revoked(secret):
        path.unlink(missing_ok=True)
        write_private(path, new_secret())
        # of two services that start at once one writes the file, and both read it
        secret = path.read_text().strip()
    backend.keys.replace(secret, label="embedded default")


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read, whole or not at all; one that is there stays."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())
    with suppress(FileExistsError):
        os.link(temporary, path)
    temporary.unlink()

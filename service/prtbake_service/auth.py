"""Who may call: bearer API keys, stored hashed, each scoped to a project."""

import os
from pathlib import Path
from typing import Annotated

from fastapi import Depends
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from prtbake_service.backend import Backend, BackendDep
from prtbake_storage.errors import Unauthorised
from prtbake_storage.records import Key

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
    new beside an old data directory takes over the key that lies there.
    """
    settings = backend.settings
    if settings.api_key is not None:
        backend.keys.create(
            label="given by the operator", secret=settings.api_key.get_secret_value()
        )
        return
    path = settings.data_dir / KEY_FILE
    if path.exists() and (secret := path.read_text().strip()):
        backend.keys.create(label="embedded default", secret=secret)
        return
    _, secret = backend.keys.create(label="embedded default")
    write_private(path, secret)


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read, never open to others even for a moment."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text + "\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)

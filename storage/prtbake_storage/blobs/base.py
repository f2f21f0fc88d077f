"""What every blob store offers.

A blob is immutable and named by its digest ``sha256:<64 hex>``.  Beside the blobs a store keeps
*results*: small JSON values under a key, written once.  They are the memory of finished tasks, and
because they live with the blobs a directory and a remote store serve the workers alike.
"""

import hashlib
import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from prtbake_storage.errors import InputError

_DIGEST = re.compile(r"sha256:[0-9a-f]{64}\Z")
_KEY = re.compile(r"[0-9a-f]{64}\Z")
_OWNER = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}\Z")

RENEW_AFTER_S = 3600.0
"""Times of use are this coarse, so that recalling what is fresh writes nothing."""


def check_digest(digest: str) -> str:
    """Return the 64 hex digits of a digest; anything else (a path, say) is an `InputError`."""
    if not _DIGEST.match(digest):
        raise InputError(f"not a digest of the form sha256:<64 hex digits>: {digest[:100]!r}")
    return digest.removeprefix("sha256:")


def check_key(key: str) -> str:
    """Return the key of a result, 64 hex digits, or raise `InputError`."""
    if not _KEY.match(key):
        raise InputError(f"not a result key of 64 hex digits: {key[:100]!r}")
    return key


def check_owner(owner: str) -> str:
    """Return the name of a scratch owner, one plain path component, or raise `InputError`."""
    if not _OWNER.match(owner):
        raise InputError(f"not a plain owner name: {owner[:100]!r}")
    return owner


def canonical_json(value: Any) -> str:
    """Write JSON with sorted keys and no spaces; NaN and infinity are a ValueError."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def json_digest(value: Any) -> str:
    """SHA-256 of a JSON value however its keys are ordered, in 64 hex digits."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


@dataclass(frozen=True)
class BlobInfo:
    """One stored blob: name, size in bytes, when last put or renewed (seconds since 1970)."""

    digest: str
    size: int
    modified: float


class BlobWriter(ABC):
    """An upload under way: nothing is visible before `commit`."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Bytes written so far."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Append; `TooLarge` beyond the limit that the writer was opened with."""

    @abstractmethod
    def commit(self, expected: str | None = None) -> str:
        """Publish atomically and return the digest; `DigestMismatch` if it is not ``expected``."""


class BlobStore(ABC):
    """A place for blobs, task results and scratch folders."""

    url: str
    """What `open_store` takes to open this store in another process."""

    @abstractmethod
    def writer(self, *, max_bytes: int | None = None) -> AbstractContextManager[BlobWriter]:
        """Open an upload; leaving the context without `commit` leaves no trace."""

    @abstractmethod
    def put_file(self, path: Path, *, expected: str | None = None, move: bool = False) -> str:
        """Store a file; ``move=True`` gives the file away, else it is copied."""

    @abstractmethod
    def open(self, digest: str) -> BinaryIO:
        """Open a blob for reading; `NotFound` if there is none."""

    @abstractmethod
    def local_path(self, digest: str) -> Path:
        """Give a read-only local file with the blob's bytes; `NotFound` if there is none."""

    @abstractmethod
    def size(self, digest: str) -> int:
        """Bytes of a blob; `NotFound` if there is none."""

    @abstractmethod
    def exists(self, digest: str) -> bool:
        """Whether the store holds the blob."""

    @abstractmethod
    def renew(self, digest: str) -> bool:
        """Keep the garbage collector away, as putting the blob again would; False if it is gone.

        What was put or renewed within `RENEW_AFTER_S` is left as it is.
        """

    @abstractmethod
    def delete(self, digest: str, *, older_than: float = math.inf) -> bool:
        """Remove a blob that was last put or renewed before a time (seconds since 1970).

        False if there was none, or it is younger: also if it was put or renewed at this moment.
        """

    @abstractmethod
    def blobs(self) -> Iterator[BlobInfo]:
        """Walk all blobs, in order of digest."""

    @abstractmethod
    def put_result(self, key: str, value: dict[str, Any]) -> dict[str, Any]:
        """Remember a task's result; the first writer wins, and what is stored is returned."""

    @abstractmethod
    def get_result(self, key: str) -> dict[str, Any] | None:
        """Recall a result, or None; an unreadable one counts as none."""

    @abstractmethod
    def renew_result(self, key: str) -> bool:
        """Keep the garbage collector away from a result, as `renew` does from a blob."""

    @abstractmethod
    def delete_result(self, key: str, *, older_than: float = math.inf) -> bool:
        """Forget a result, as `delete` removes a blob; False if there was none or it is younger."""

    @abstractmethod
    def results(self) -> Iterator[tuple[str, float]]:
        """Walk all results: (key, when it was put or renewed in seconds since 1970)."""

    @abstractmethod
    def scratch(self) -> AbstractContextManager[Path]:
        """Lend an empty folder on the store's file system, removed afterwards."""

    @abstractmethod
    def sweep_scratch(
        self, *, owner: str | None = None, older_than_s: float = 0.0, keep: Collection[str] = ()
    ) -> int:
        """Remove scratch that a killed process left.

        One owner's, or what no owner in ``keep`` has and nobody has written to for so long.
        """

    def put_bytes(self, data: bytes, *, expected: str | None = None) -> str:
        """Store bytes and return their digest; `DigestMismatch` if it is not ``expected``."""
        with self.writer() as writer:
            writer.write(data)
            return writer.commit(expected)

    def read_bytes(self, digest: str) -> bytes:
        """Read a whole blob."""
        with self.open(digest) as file:
            return file.read()


def referenced_digests(value: Any) -> Iterator[str]:
    """Find every digest inside a JSON value."""
    if isinstance(value, str):
        if _DIGEST.match(value):
            yield value
    elif isinstance(value, dict):
        for part in value.values():
            yield from referenced_digests(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from referenced_digests(part)

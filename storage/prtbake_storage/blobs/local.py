"""Blobs in a local directory.

::

    blobs/ab/<64 hex>          read-only, named by their SHA-256, 256 shards
    results/ab/<64 hex>.json   what finished tasks returned
    scratch/<owner>/<random>/  work in progress; ``owner`` is the process that must clean up
    scratch/<name>.<random>    a blob or result at the moment of its removal

Every file is written under ``scratch``, fsynced, and renamed into place, so that a reader sees all
of it or nothing, and a killed writer leaves nothing outside ``scratch``.
"""

import hashlib
import json
import math
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from prtbake_storage.blobs.base import (
    RENEW_AFTER_S,
    BlobInfo,
    BlobStore,
    BlobWriter,
    canonical_json,
    check_digest,
    check_key,
    check_owner,
)
from prtbake_storage.errors import DigestMismatch, NotFound, TooLarge

_READ_ONLY = 0o444
_CHUNK = 1 << 20  # 1 MiB


class LocalBlobStore(BlobStore):
    """A content-addressed directory.

    Parameters
    ----------
    root
        The directory; created if it is missing.
    owner
        Who cleans up the scratch folders of this process: a worker gives its executor id, so that
        whoever declares it dead can sweep them.
    incoming
        Where files are written before they are renamed, on the same file system; a task's child
        gives its own scratch folder, which its worker removes even if the child is killed.
    """

    def __init__(self, root: Path, *, owner: str = "local", incoming: Path | None = None) -> None:
        self.root = root.absolute()
        self.url = self.root.as_uri()
        self.owner = check_owner(owner)
        self._incoming = incoming
        for name in ("blobs", "results", "scratch"):
            (self.root / name).mkdir(parents=True, exist_ok=True)

    @contextmanager
    def writer(self, *, max_bytes: int | None = None) -> Iterator["LocalWriter"]:
        """Open an upload; leaving the context without `commit` leaves no trace."""
        with self._temporary() as path, path.open("wb") as file:
            yield LocalWriter(self, file, path, max_bytes)

    def put_file(self, path: Path, *, expected: str | None = None, move: bool = False) -> str:
        """Store a file; ``move=True`` gives the file away, else it is copied."""
        if move:
            with path.open("rb") as file:
                digest = f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"
                _expect(digest, expected)
                os.fsync(file.fileno())
            try:
                self.publish(path, digest)
            except OSError:  # another file system: fall through to the copy
                if not path.exists():
                    raise
            else:
                return digest
        with path.open("rb") as file, self.writer() as writer:
            while chunk := file.read(_CHUNK):
                writer.write(chunk)
            digest = writer.commit(expected)
        if move:
            path.unlink()
        return digest

    def open(self, digest: str) -> BinaryIO:
        """Open a blob for reading; `NotFound` if there is none."""
        try:
            return self._blob(digest).open("rb")
        except FileNotFoundError:
            raise NotFound(f"there is no blob {digest}") from None

    def local_path(self, digest: str) -> Path:
        """Give the blob's own file, which is read-only; `NotFound` if there is none."""
        path = self._blob(digest)
        if not path.is_file():
            raise NotFound(f"there is no blob {digest}")
        return path

    def size(self, digest: str) -> int:
        """Bytes of a blob; `NotFound` if there is none."""
        return self.local_path(digest).stat().st_size

    def exists(self, digest: str) -> bool:
        """Whether the store holds the blob."""
        return self._blob(digest).is_file()

    def renew(self, digest: str) -> bool:
        """Keep the garbage collector away, as putting the blob again would; False if it is gone."""
        return _renew(self._blob(digest))

    def delete(self, digest: str, *, older_than: float = math.inf) -> bool:
        """Remove a blob that was last put or renewed before a time (seconds since 1970)."""
        return self._remove(self._blob(digest), older_than)

    def blobs(self) -> Iterator[BlobInfo]:
        """Walk all blobs, in order of digest."""
        for path in sorted((self.root / "blobs").glob("??/*")):
            with suppress(FileNotFoundError):  # deleted while we walk
                status = path.stat()
                yield BlobInfo(f"sha256:{path.name}", status.st_size, status.st_mtime)

    def put_result(self, key: str, value: dict[str, Any]) -> dict[str, Any]:
        """Remember a task's result; the first writer wins, and what is stored is returned."""
        target = self._result(key)
        target.parent.mkdir(exist_ok=True)
        with self._temporary() as path:
            with path.open("w", encoding="utf-8") as file:
                file.write(canonical_json(value))
                file.flush()
                os.fsync(file.fileno())
            try:
                os.link(path, target)
            except FileExistsError:
                if (stored := self.get_result(key)) is not None:
                    return stored
                path.replace(target)  # what was there could not be read
            except OSError:  # a file system without hard links: the last writer wins instead
                path.replace(target)
            _sync_folder(target.parent)
        return value

    def get_result(self, key: str) -> dict[str, Any] | None:
        """Recall a result, or None; an unreadable one counts as none."""
        path = self._result(key)
        try:
            value = json.loads(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            return None
        return value if isinstance(value, dict) else None

    def renew_result(self, key: str) -> bool:
        """Keep the garbage collector away from a result; False if there is none."""
        return _renew(self._result(key))

    def delete_result(self, key: str, *, older_than: float = math.inf) -> bool:
        """Forget a result that was last put or renewed before a time (seconds since 1970)."""
        return self._remove(self._result(key), older_than)

    def results(self) -> Iterator[tuple[str, float]]:
        """Walk all results: (key, when it was put or renewed in seconds since 1970)."""
        for path in sorted((self.root / "results").glob("??/*.json")):
            with suppress(FileNotFoundError):
                yield path.stem, path.stat().st_mtime

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Lend an empty folder on the store's file system, removed afterwards."""
        folder = self.root / "scratch" / self.owner
        path = Path(_retry_mkdtemp(folder))
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)
            with suppress(OSError):  # another task of this owner still works
                folder.rmdir()

    def sweep_scratch(
        self, *, owner: str | None = None, older_than_s: float = 0.0, keep: Collection[str] = ()
    ) -> int:
        """Remove scratch that a killed process left.

        One owner's, or what no owner in ``keep`` has and nobody has written to for so long.
        """
        scratch = self.root / "scratch"
        if owner is not None:
            found = list(scratch.glob(f"{check_owner(owner)}/*"))
        else:  # files at the top were set aside by a `delete` that was killed
            found = [*scratch.glob("*/*"), *filter(Path.is_file, scratch.glob("*"))]
        limit = time.time() - older_than_s
        swept = 0
        for path in found:
            if path.parent.name in keep:
                continue
            with suppress(FileNotFoundError):
                if path.stat().st_mtime > limit:
                    continue
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()
                swept += 1
        for folder in scratch.glob("*"):
            with suppress(OSError):  # not empty: somebody works there
                folder.rmdir()
        return swept

    def publish(self, path: Path, digest: str) -> None:
        """Rename a finished, fsynced file to the name of its bytes."""
        target = self._blob(digest)
        target.parent.mkdir(exist_ok=True)
        path.chmod(_READ_ONLY)
        # the same bytes may be there already: replacing them renews their time, which keeps the
        # garbage collector away, and mends a file that was cut short behind our back
        path.replace(target)
        _sync_folder(target.parent)

    def _remove(self, path: Path, older_than: float) -> bool:
        # out of reach first: seen in its place, it could be renewed between the look and the end
        aside = self.root / "scratch" / f"{path.name}.{uuid.uuid4().hex}"
        try:
            path.replace(aside)
        except FileNotFoundError:
            return False
        if aside.stat().st_mtime < older_than:
            aside.unlink()
            return True
        aside.replace(path)
        _sync_folder(path.parent)
        return False

    @contextmanager
    def _temporary(self) -> Iterator[Path]:
        folder = self._incoming or self.root / "scratch" / self.owner
        path = Path(_retry_mkstemp(folder))
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)
            if self._incoming is None:
                with suppress(OSError):
                    folder.rmdir()

    def _blob(self, digest: str) -> Path:
        name = check_digest(digest)
        return self.root / "blobs" / name[:2] / name

    def _result(self, key: str) -> Path:
        return self.root / "results" / check_key(key)[:2] / f"{key}.json"


class LocalWriter(BlobWriter):
    """An upload into a `LocalBlobStore`."""

    def __init__(
        self, store: LocalBlobStore, file: BinaryIO, path: Path, max_bytes: int | None
    ) -> None:
        self._store, self._file, self._path = store, file, path
        self._max_bytes = max_bytes
        self._hash = hashlib.sha256()
        self._size = 0

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._size

    def write(self, data: bytes) -> None:
        """Append; `TooLarge` beyond the limit that the writer was opened with."""
        self._size += len(data)
        if self._max_bytes is not None and self._size > self._max_bytes:
            raise TooLarge(f"more than the {self._max_bytes} bytes that are allowed here")
        self._hash.update(data)
        self._file.write(data)

    def commit(self, expected: str | None = None) -> str:
        """Publish atomically and return the digest; `DigestMismatch` if it is not ``expected``."""
        digest = f"sha256:{self._hash.hexdigest()}"
        _expect(digest, expected)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._store.publish(self._path, digest)
        return digest


def _expect(digest: str, expected: str | None) -> None:
    if expected is not None and f"sha256:{check_digest(expected)}" != digest:
        raise DigestMismatch(f"the bytes are {digest}, not {expected}")


def _renew(path: Path) -> bool:
    try:
        if path.stat().st_mtime < time.time() - RENEW_AFTER_S:
            os.utime(path)
    except FileNotFoundError:
        return False
    return True


def _sync_folder(folder: Path) -> None:
    # a rename survives a power cut only once its directory is on disk
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _retry_mkdtemp(folder: Path) -> str:
    # a sibling that has just finished may remove the empty folder between our two calls
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            return tempfile.mkdtemp(dir=folder)


def _retry_mkstemp(folder: Path) -> str:
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            handle, name = tempfile.mkstemp(dir=folder)
            os.close(handle)
            return name

"""Files on their way up: digest and registration by what the file is."""

import hashlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

from anyio import to_thread

CHUNK_BYTES = 1 << 20  # 1 MiB: large enough for the disk, small enough for progress


def file_digest(path: Path) -> str:
    """Return ``sha256:`` and the hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


def chunks(path: Path) -> Iterator[bytes]:
    """Read a file piece by piece."""
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk


async def chunks_async(path: Path) -> AsyncIterator[bytes]:
    """Read a file piece by piece, off the event loop."""
    with await to_thread.run_sync(path.open, "rb") as file:
        while chunk := await to_thread.run_sync(file.read, CHUNK_BYTES):
            yield chunk

"""The memory of finished tasks."""

from typing import Any, NamedTuple

from prtbake_storage.blobs.base import BlobStore, referenced_digests
from prtbake_storage.queue.stages import Measured


class Memory(NamedTuple):
    """A task's result and what it cost."""

    result: dict[str, Any]
    measured: Measured


def recall(store: BlobStore, key: str) -> Memory | None:
    """Find the result of a finished task; None if it is unknown or a blob that it names is gone."""
    value = store.get_result(key)
    if value is None:
        return None
    if not all(store.exists(digest) for digest in referenced_digests(value["result"])):
        store.delete_result(key)
        return None
    return _read(value)


def remember(store: BlobStore, key: str, memory: Memory) -> Memory:
    """Keep a task's result.  The first one stays, so that all readers agree on its costs too."""
    stored = store.put_result(
        key,
        {
            "result": memory.result,
            "seconds": memory.measured.seconds,
            "peak_memory_bytes": memory.measured.peak_memory_bytes,
        },
    )
    return _read(stored)


def _read(value: dict[str, Any]) -> Memory:
    return Memory(value["result"], Measured(value["seconds"], value["peak_memory_bytes"]))

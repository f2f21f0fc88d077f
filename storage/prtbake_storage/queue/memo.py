"""The memory of finished tasks."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from prtbake_storage.blobs.base import BlobStore, referenced_digests
from prtbake_storage.queue.stages import Measured, Results, Stage


class Memory(NamedTuple):
    """A task's result and what it cost."""

    result: dict[str, Any]
    measured: Measured


def recall(store: BlobStore, key: str) -> Memory | None:
    """Find the result of a finished task; None if it is unknown or a blob that it names is gone.

    What is recalled is renewed with its blobs: the garbage collector leaves it alone for as long as
    if it had been made now.
    """
    value = store.get_result(key)
    if value is None:
        return None
    digests = referenced_digests(value["result"])
    if store.renew_result(key) and all(store.renew(digest) for digest in digests):
        return _read(value)
    store.delete_result(key)
    return None


def enter(
    results: Results, stage: Stage, memories: Sequence[Memory], *, recalled: bool = False
) -> None:
    """Enter the memories of a finished stage, or of a round of one that repeats, in order."""
    add = results.add if stage.rounds is None else results.add_round
    add(
        stage.name,
        [memory.result for memory in memories],
        [memory.measured for memory in memories],
        recalled=recalled,
    )


def finished_tasks(store: BlobStore, stages: Iterable[Stage]) -> Iterator[str]:
    """Keys of a job's remembered tasks, up to the first stage that is not done."""
    results = Results()
    for stage in stages:
        for tasks in stage.lists(results):
            keys = [task.key for task in tasks]
            found = {key: value for key in keys if (value := store.get_result(key)) is not None}
            yield from found
            if len(found) < len(set(keys)):
                return
            enter(results, stage, [_read(found[key]) for key in keys])


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

"""Collection of blobs and results that nothing refers to any more."""

import time
from collections.abc import Collection
from dataclasses import dataclass

from prtbake_storage.blobs.base import BlobStore


@dataclass(frozen=True)
class GarbageReport:
    """What was removed, or with ``dry_run`` would be."""

    n_blobs: int
    n_bytes: int
    n_results: int
    dry_run: bool


def collect_garbage(
    store: BlobStore, keep: Collection[str], *, older_than_s: float, dry_run: bool = False
) -> GarbageReport:
    """Remove old blobs that are not in ``keep``, and old results.

    Parameters
    ----------
    store
        Where to collect.
    keep
        Digests in use: uploads, resources, artefacts, and what unfinished jobs were given.
    older_than_s
        Age in seconds below which nothing is touched.  It must exceed the longest job, because the
        tiles of a running job are referred to by results only.
    dry_run
        Count, remove nothing.
    """
    limit = time.time() - older_than_s
    # results first: a task whose result is gone is run again, one whose blobs are gone would fail
    results = [key for key, modified in store.results() if modified < limit]
    blobs = [blob for blob in store.blobs() if blob.modified < limit and blob.digest not in keep]
    if not dry_run:
        for key in results:
            store.delete_result(key)
        for blob in blobs:
            store.delete(blob.digest)
    return GarbageReport(len(blobs), sum(blob.size for blob in blobs), len(results), dry_run)

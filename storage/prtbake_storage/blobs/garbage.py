"""Collection of blobs and results that nothing refers to any more."""

import time
from collections.abc import Collection
from dataclasses import dataclass

from prtbake_storage.blobs.base import BlobStore, referenced_digests


@dataclass(frozen=True)
class GarbageReport:
    """What was removed, or with ``dry_run`` would be."""

    n_blobs: int
    n_bytes: int
    n_results: int
    dry_run: bool


def collect_garbage(
    store: BlobStore,
    keep: Collection[str],
    *,
    keep_results: Collection[str] = (),
    older_than_s: float,
    dry_run: bool = False,
) -> GarbageReport:
    """Remove old results, and old blobs that neither ``keep`` nor a result that stays names.

    Parameters
    ----------
    store
        Where to collect.
    keep
        Digests in use: uploads, resources, artefacts, and what unfinished jobs were given.
    keep_results
        Keys of results that stay whatever their age: those of unfinished jobs.
    older_than_s
        Age in seconds below which nothing is touched.  It must exceed the longest task, whose blobs
        nothing names before its end.
    dry_run
        Count, remove nothing.
    """
    limit = time.time() - older_than_s
    ages = dict(store.results())
    results = [key for key, put in ages.items() if put < limit and key not in keep_results]
    live = set(keep)
    for key in ages.keys() - results:
        live.update(referenced_digests(store.get_result(key)))
    blobs = [blob for blob in store.blobs() if blob.modified < limit and blob.digest not in live]
    if not dry_run:
        # results first: a task whose result is gone is run again, one whose blobs are gone would
        # fail; and by age again: what was put or recalled since we looked is in use
        results = [key for key in results if store.delete_result(key, older_than=limit)]
        blobs = [blob for blob in blobs if store.delete(blob.digest, older_than=limit)]
    return GarbageReport(len(blobs), sum(blob.size for blob in blobs), len(results), dry_run)

"""Collect the blobs and remembered results that no job needs any more."""

import logging
import threading
from dataclasses import asdict

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.garbage import GarbageReport, collect_garbage
from prtbake_storage.queue.memo import finished_tasks
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.queue.stages import JobRunner
from prtbake_storage.records.database import Database
from prtbake_storage.records.references import referenced_blobs
from prtbake_storage.records.runs import Runs

_log = logging.getLogger(__name__)


class Collector:
    """Tells what is in use: by rows, by unfinished jobs, or for being young."""

    def __init__(
        self, database: Database, store: BlobStore, runner: JobRunner, settings: QueueSettings
    ) -> None:
        self._database, self._store, self._runner = database, store, runner
        self._settings = settings

    def run(self, stop: threading.Event) -> None:
        """Collect at once, and then every ``garbage_every_s`` seconds until told to stop."""
        while True:
            try:
                report = self.collect()
                if report.n_blobs or report.n_results:
                    _log.info("garbage.collected", extra=asdict(report))
            except Exception as error:  # noqa: BLE001 - the next round may find database and blobs
                _log.warning("garbage.failed", extra={"error": str(error)[:200]})
            if stop.wait(self._settings.garbage_every_s):
                return

    def collect(self, *, dry_run: bool = False) -> GarbageReport:
        """Collect once; several workers may do so at the same time."""
        # unfinished jobs before rows: one that succeeds in between is seen by its artefacts' rows
        keep_results = self._results_in_use()
        return collect_garbage(
            self._store,
            referenced_blobs(self._database),
            keep_results=keep_results,
            older_than_s=self._settings.garbage_grace_s,
            dry_run=dry_run,
        )

    def _results_in_use(self) -> set[str]:
        keys: set[str] = set()
        for job in Runs(self._database).given():
            try:
                stages = self._runner.stages(job.kind, job.request, job.context)
                keys.update(finished_tasks(self._store, stages))
            except Exception as error:  # noqa: BLE001 - a job that cannot be planned has no results
                _log.warning("garbage.unplanned", extra={"job_id": job.job_id, "error": str(error)})
        return keys

"""Bring our rows and the engine's workflows together.

A submission commits twice: our row, then the engine's.  A process that dies in between leaves a
queued job that no worker will ever see; one whose workflow the engine gave up leaves a row that
runs for ever.  Both are found by comparing the two, at start and every few seconds, by anybody.
"""

import logging
import threading
from collections import Counter
from datetime import UTC, datetime, timedelta

from prtbake_storage.contract.jobs import JobError, JobState
from prtbake_storage.queue.engine import ENDED, GIVEN_UP, JobQueue, poison
from prtbake_storage.queue.retention import let_go
from prtbake_storage.records.database import Database
from prtbake_storage.records.runs import Runs, Stop, Unfinished
from prtbake_storage.records.workers import Workers

_log = logging.getLogger(__name__)

LET_GO_EVERY_S = 3600.0

MOST_RENEWALS = 3
"""Workflows of one job that may end before the job has begun; one is what a deletion cut short."""


def reconcile_once(
    database: Database,
    queue: JobQueue,
    *,
    dead_after_s: float = 30.0,
    renewals: Counter[str] | None = None,
) -> int:
    """Submit jobs that have no workflow and close jobs whose workflow has ended.

    Parameters
    ----------
    database, queue
        Our rows and the engine's workflows.
    dead_after_s
        Silence after which a worker counts as dead.
    renewals
        How often the caller has made a job's workflow anew: counted here, and a job that comes to
        more than `MOST_RENEWALS` is closed, for it would end like the others.

    Returns
    -------
    int
        How many jobs were mended.
    """
    runs = Runs(database)
    renewals = Counter() if renewals is None else renewals
    mended, stopping = 0, []
    for jobs in runs.unfinished():
        statuses = queue.statuses([job.job_id for job in jobs])
        mended += sum(_mend(runs, queue, job, statuses.get(job.job_id), renewals) for job in jobs)
        stopping += [job.job_id for job in jobs if job.state == JobState.cancel_requested]
    if stopping and not _anybody_lives(database, dead_after_s):
        # nobody is left to stop anything, and nothing runs: the wish is fulfilled
        for job_id in stopping:
            queue.cancel([job_id])
            mended += runs.close(job_id, Stop(JobState.canceled))
    return mended


def _mend(
    runs: Runs, queue: JobQueue, job: Unfinished, status: str | None, renewals: Counter[str]
) -> bool:
    """Bring one job and its workflow together; tell whether they were not."""
    if status is None:
        queue.submit(job.job_id, quick=job.quick, priority=job.priority)
        _log.info("job.resubmitted", extra={"job_id": job.job_id})
        return True
    if _never_began(job, status) and renewals[job.job_id] < MOST_RENEWALS:
        # the workflow is that of an earlier job with this id, or could not be read
        renewals[job.job_id] += 1
        queue.forget(job.job_id)
        queue.submit(job.job_id, quick=job.quick, priority=job.priority)
        return True
    # the row may have been closed since we read it: then `close` does nothing
    return status in ENDED and runs.close(job.job_id, _verdict(job, status), cause="engine")


class Reconciler:
    """Reconciles in a thread of its own, at once and then every ``every_s`` seconds.

    Parameters
    ----------
    retention_s
        Age at which is let go what `retention` says, once an hour; without it nothing is.  Only the
        workers, which this is a setting of, let go: nobody else knows what the operator wants.
    """

    def __init__(
        self,
        database: Database,
        queue: JobQueue,
        *,
        every_s: float = 10.0,
        dead_after_s: float = 30.0,
        retention_s: float | None = None,
    ) -> None:
        self._database, self._queue = database, queue
        self._every_s, self._dead_after_s = every_s, dead_after_s
        self._retention_s = retention_s
        self._renewals: Counter[str] = Counter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reconciler", daemon=True)

    def start(self) -> "Reconciler":
        """Begin."""
        self._thread.start()
        return self

    def stop(self) -> None:
        """End, after the round under way."""
        self._stop.set()
        self._thread.join(timeout=30.0)

    def _run(self) -> None:
        since_letting_go = LET_GO_EVERY_S
        while True:
            try:
                reconcile_once(
                    self._database,
                    self._queue,
                    dead_after_s=self._dead_after_s,
                    renewals=self._renewals,
                )
                if since_letting_go >= LET_GO_EVERY_S:
                    since_letting_go = 0.0
                    self._let_go()
            except Exception as error:  # noqa: BLE001 - the next round may find the database again
                _log.warning("reconcile.failed", extra={"error": str(error)[:200]})
            if self._stop.wait(self._every_s):
                return
            since_letting_go += self._every_s

    def _let_go(self) -> None:
        if self._retention_s is None:
            return
        ended_before = datetime.now(UTC) - timedelta(seconds=self._retention_s)
        if n_gone := let_go(self._database, self._queue, ended_before=ended_before):
            _log.info("retention.let_go", extra={"n_rows": n_gone})


def _never_began(job: Unfinished, status: str) -> bool:
    return job.state == JobState.queued and status in ENDED - {GIVEN_UP}


def _verdict(job: Unfinished, status: str) -> Stop:
    if job.state == JobState.cancel_requested:
        return Stop(JobState.canceled)
    if status == GIVEN_UP:
        return Stop(JobState.failed, poison("too many workers were lost while they ran this job"))
    detail = f"the engine ended this job as {status} while it was {job.state}"
    return Stop(JobState.failed, JobError(kind="internal", code="engine", detail=detail))


def _anybody_lives(database: Database, dead_after_s: float) -> bool:
    return any(
        worker.state == "up" and worker.age_s < dead_after_s for worker in Workers(database).all()
    )

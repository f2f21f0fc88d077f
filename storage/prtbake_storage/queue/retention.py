"""Let go of what nobody asks for any more: ended workflows, and the service's own ended jobs.

Both appear in no list, so that no caller deletes them.  The jobs that callers submitted stay until
they are deleted.
"""

from datetime import datetime

from prtbake_storage.queue.engine import JobQueue
from prtbake_storage.records.database import Database
from prtbake_storage.records.internal import InternalJobs

BATCH = 500
"""Rows of one transaction: SQLite lets nobody else write meanwhile."""


def let_go(database: Database, queue: JobQueue, *, ended_before: datetime) -> int:
    """Delete what ended before a time; returns how many workflows and jobs that were.

    A job goes after its workflow, without which its id, that of a registration, may be used anew.
    """
    n_gone = 0
    while n_workflows := queue.prune(ended_before.isoformat(), limit=BATCH):
        n_gone += n_workflows
    jobs = InternalJobs(database)
    ended = jobs.ended(ended_before)
    for start in range(0, len(ended), BATCH):
        job_ids = ended[start : start + BATCH]
        held = queue.statuses(job_ids)
        n_gone += jobs.delete([job_id for job_id in job_ids if job_id not in held])
    return n_gone

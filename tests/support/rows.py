"""What the database holds of a job beside what the API shows."""

from typing import Any

from prtbake_storage.records import Database
from prtbake_storage.records.models import JobRow


def context_of(database: Database, job_id: str) -> dict[str, Any]:
    """What the job was given beside its request."""
    with database.read() as session:
        return session.get_one(JobRow, job_id).context


def revision_of(database: Database, job_id: str) -> int:
    """How often the job has changed."""
    with database.read() as session:
        return session.get_one(JobRow, job_id).revision

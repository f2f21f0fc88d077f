"""Which blobs the records still need."""

import sqlalchemy as sa

from prtbake_storage.blobs.base import referenced_digests
from prtbake_storage.contract.jobs import TERMINAL
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import ArtefactRow, JobRow, ResourceRow, UploadRow


def referenced_blobs(database: Database) -> set[str]:
    """Digests of uploads, resources and artefacts, and of all that unfinished jobs were given."""
    with database.read() as session:
        used = set(session.scalars(sa.select(UploadRow.digest)))
        used |= set(session.scalars(sa.select(ArtefactRow.digest)))
        for resource in session.scalars(sa.select(ResourceRow)):
            used |= set(referenced_digests([resource.canonical, resource.request]))
        for request, context in session.execute(
            sa.select(JobRow.request, JobRow.context).where(
                JobRow.state.not_in([state.value for state in TERMINAL])
            )
        ):
            used |= set(referenced_digests([request, context]))
    return used

"""Which blobs the records still need."""

import sqlalchemy as sa

from prtbake_storage.blobs.base import referenced_digests
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import ArtefactRow, ResourceRow, UploadRow
from prtbake_storage.records.runs import Runs


def referenced_blobs(database: Database) -> set[str]:
    """Digests of uploads, resources and artefacts, and of all that unfinished jobs were given."""
    used: set[str] = set()
    for job in Runs(database).given():
        used.update(referenced_digests([job.request, job.context]))
    with database.read() as session:
        used.update(session.scalars(sa.select(UploadRow.digest)))
        used.update(session.scalars(sa.select(ArtefactRow.digest)))
        for resource in session.scalars(sa.select(ResourceRow)):
            used.update(referenced_digests([resource.canonical, resource.request]))
    return used

"""Which project uploaded which blob."""

from collections.abc import Collection

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError

from prtbake_storage.contract.resources import Upload
from prtbake_storage.errors import NotFound
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import UploadRow


class Uploads:
    """Reads and writes uploads."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, digest: str, size: int, *, project: str = "default") -> bool:
        """Record an upload; False if the project has it already."""
        try:
            with self._database.write() as session:
                session.add(UploadRow(project=project, digest=digest, size=size, created=utc_now()))
        except IntegrityError:
            return False
        return True

    def get(self, digest: str, *, project: str = "default") -> Upload:
        """Look an upload up; `NotFound` if the project has no such blob."""
        with self._database.read() as session:
            row = session.get(UploadRow, (project, digest))
            if row is None:
                raise NotFound(f"there is no upload {digest}")
            return Upload(digest=row.digest, size=row.size)

    def missing(self, digests: Collection[str], *, project: str = "default") -> list[str]:
        """Those of the digests that the project has not uploaded, in the order given."""
        with self._database.read() as session:
            known = set(
                session.scalars(
                    sa.select(UploadRow.digest).where(
                        UploadRow.project == project, UploadRow.digest.in_(list(digests))
                    )
                )
            )
        return [digest for digest in digests if digest not in known]

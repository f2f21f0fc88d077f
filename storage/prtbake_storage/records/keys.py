"""API keys: shown once, stored as a hash."""

import hashlib
import secrets
from dataclasses import dataclass

import sqlalchemy as sa

from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.database import Database
from prtbake_storage.records.models import ApiKeyRow


@dataclass(frozen=True)
class Key:
    """A key's place: which project it opens."""

    id: str
    project: str
    label: str


class Keys:
    """Makes, checks and revokes keys."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self, *, project: str = "default", label: str = "", secret: str | None = None
    ) -> tuple[Key, str]:
        """Make a key, or enter a given secret; the secret is returned here and never again."""
        secret = secret or f"prtbake_{secrets.token_urlsafe(32)}"
        if (known := self.verify(secret)) is not None:
            return known, secret
        row = ApiKeyRow(
            id=secrets.token_hex(8),
            hash=_digest(secret),
            project=project,
            label=label,
            created=utc_now(),
        )
        with self._database.write() as session:
            session.add(row)
        return Key(row.id, row.project, row.label), secret

    def verify(self, secret: str) -> Key | None:
        """Find the key that a secret opens; None if there is none or it was revoked."""
        # 256 random bits need no slow hash, and looking up by hash leaks no timing of the secret
        with self._database.read() as session:
            row = session.scalars(
                sa.select(ApiKeyRow).where(
                    ApiKeyRow.hash == _digest(secret), ApiKeyRow.revoked.is_(None)
                )
            ).first()
            return Key(row.id, row.project, row.label) if row is not None else None

    def revoke(self, key_id: str) -> bool:
        """Close a key; False if there was none open."""
        with self._database.write() as session:
            closed = session.execute(
                sa.update(ApiKeyRow)
                .where(ApiKeyRow.id == key_id, ApiKeyRow.revoked.is_(None))
                .values(revoked=utc_now())
                .returning(ApiKeyRow.id)
            ).first()
            return closed is not None


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()

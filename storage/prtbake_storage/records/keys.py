"""API keys: shown once, stored as a hash."""

import hashlib
import secrets
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

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

    def create(self, *, project: str = "default", label: str = "") -> tuple[Key, str]:
        """Make a key; the secret is returned here and never again."""
        secret = new_secret()
        with self._database.write() as session:
            row = _insert(session, secret, project, label)
        return Key(row.id, row.project, row.label), secret

    def replace(self, secret: str, *, project: str = "default", label: str) -> Key:
        """Open a key with a given secret and close the others of its label: the secret it had."""
        try:
            return self._replace(secret, project, label)
        except IntegrityError:  # another service entered it at this moment
            return self._replace(secret, project, label)

    def _replace(self, secret: str, project: str, label: str) -> Key:
        with self._database.write() as session:
            row = session.scalars(
                sa.select(ApiKeyRow).where(ApiKeyRow.hash == _digest(secret))
            ).first()
            if row is None:
                row = _insert(session, secret, project, label)
            row.revoked = None
            session.execute(
                sa.update(ApiKeyRow)
                .where(
                    ApiKeyRow.project == project,
                    ApiKeyRow.label == label,
                    ApiKeyRow.id != row.id,
                    ApiKeyRow.revoked.is_(None),
                )
                .values(revoked=utc_now())
            )
            return Key(row.id, row.project, row.label)

    def verify(self, secret: str) -> Key | None:
        """Find the key that a secret opens; None if there is none or it was revoked."""
        # a long random secret needs no slow hash, and looking up by hash leaks no timing of it
        with self._database.read() as session:
            row = session.scalars(
                sa.select(ApiKeyRow).where(
                    ApiKeyRow.hash == _digest(secret), ApiKeyRow.revoked.is_(None)
                )
            ).first()
            return Key(row.id, row.project, row.label) if row is not None else None

    def is_revoked(self, secret: str) -> bool:
        """Whether there was a key with this secret that has been closed."""
        with self._database.read() as session:
            found = session.scalars(
                sa.select(ApiKeyRow.id).where(
                    ApiKeyRow.hash == _digest(secret), ApiKeyRow.revoked.is_not(None)
                )
            ).first()
            return found is not None

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


def new_secret() -> str:
    """Draw a secret of 256 random bits."""
    return f"prtbake_{secrets.token_urlsafe(32)}"


def _insert(session: Session, secret: str, project: str, label: str) -> ApiKeyRow:
    row = ApiKeyRow(
        id=secrets.token_hex(8),
        hash=_digest(secret),
        project=project,
        label=label,
        created=utc_now(),
    )
    session.add(row)
    session.flush()
    return row


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()

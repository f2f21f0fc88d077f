"""Connections and transactions on SQLite and PostgreSQL."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from prtbake_storage.errors import SettingsError
from prtbake_storage.records.clock import database_seconds
from prtbake_storage.records.migrate import migrate

BUSY_TIMEOUT_MS = 30_000
"""How long SQLite waits for another writer: ours hold the lock for milliseconds."""

_WRITES = "prtbake_writes"


def normalise_url(url: str) -> sa.URL:
    """Read a database URL; ``postgresql://`` means psycopg 3, ``sqlite://`` needs a file."""
    try:
        parsed = sa.make_url(url)
    except sa.exc.ArgumentError as error:
        raise SettingsError(f"database_url: {error}", pointer="/database_url") from error
    backend = parsed.get_backend_name()
    if backend == "sqlite":
        if not parsed.database or parsed.database == ":memory:":
            raise SettingsError(
                "database_url must name a SQLite file: several processes share it",
                pointer="/database_url",
            )
        return parsed
    if backend in ("postgresql", "postgres"):
        return parsed.set(drivername="postgresql+psycopg")
    raise SettingsError(
        f"database_url must be sqlite:///file or postgresql://..., not {backend}",
        pointer="/database_url",
    )


def create_engine(url: str) -> sa.Engine:
    """Open a pool of connections with the transaction rules of `Database`."""
    parsed = normalise_url(url)
    if parsed.get_backend_name() != "sqlite":
        return sa.create_engine(parsed, pool_pre_ping=True, pool_size=5, max_overflow=15)
    if parsed.database:
        Path(parsed.database).absolute().parent.mkdir(parents=True, exist_ok=True)
    engine = sa.create_engine(parsed)

    @sa.event.listens_for(engine, "connect")
    def _prepare(connection: Any, _record: Any) -> None:
        # we say BEGIN ourselves: the driver would do so only before the first write
        connection.isolation_level = None
        connection.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA foreign_keys=ON")

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # a transaction that reads first and writes later fails at once if another writer came in
        # between, whatever the busy timeout; so those that may write take the lock at the start
        writes = connection.get_execution_options().get(_WRITES)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


class Database:
    """The records' database; one object a process, shared by its threads."""

    def __init__(self, engine: sa.Engine) -> None:
        self.engine = engine
        self._writing = engine.execution_options(**{_WRITES: True})

    @property
    def seconds(self) -> sa.ColumnElement[float]:
        """Seconds since 1970 by the database's clock, as an SQL expression."""
        return database_seconds(self.engine.dialect.name)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Open a transaction that only reads."""
        with Session(self.engine, expire_on_commit=False) as session, session.begin():
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Open a transaction that commits at the end, or rolls back on an error."""
        with Session(self._writing, expire_on_commit=False) as session, session.begin():
            yield session

    def dispose(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def create_database(url: str) -> Database:
    """Open a database and bring its tables up to date, however many processes do so at once."""
    engine = create_engine(url)
    migrate(engine.execution_options(**{_WRITES: True}))
    return Database(engine)

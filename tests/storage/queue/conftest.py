"""A migrated database, once on SQLite and once on PostgreSQL."""

from collections.abc import Iterator

import pytest

from prtbake_storage.records import Database, create_database


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    database = create_database(database_url)
    yield database
    database.dispose()

"""Records on both databases."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from prtbake_storage.records import Database, create_database
from prtbake_storage.records.models import Base
from prtbake_storage.testing.postgres import fresh_database


@pytest.fixture(
    scope="session", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)]
)
def migrated(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Database]:
    """A migrated database for the whole session: making one anew for each test would take minutes."""
    with ExitStack() as stack:
        if request.param == "sqlite":
            url = f"sqlite:///{tmp_path_factory.mktemp('records') / 'prtbake.sqlite'}"
        else:
            url = stack.enter_context(fresh_database(request.getfixturevalue("postgres_url")))
        database = create_database(url)
        yield database
        database.dispose()


@pytest.fixture
def database(migrated: Database) -> Database:
    """A migrated database without a row."""
    with migrated.write() as session:
        for table in reversed(Base.metadata.sorted_tables):
            session.execute(table.delete())
    return migrated

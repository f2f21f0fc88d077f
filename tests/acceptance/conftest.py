"""One installation as users start it, and the main job that ran on it undisturbed."""

from collections.abc import Iterator

import pytest

from prtbake_storage.testing.postgres import fresh_database
from support.deployment import EAGER, Installation, installed, without_settings
from support.main_job import Finished, main_request


@pytest.fixture(scope="session", autouse=True)
def _no_settings_of_the_user() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in without_settings(kept=("PRTBAKE_DATA", "PRTBAKE_TEST_POSTGRES_URL")):
            patch.delenv(name)
        yield


@pytest.fixture(scope="session")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """A service and two workers with the settings they come with."""
    with installed(tmp_path_factory.mktemp("local")) as installation:
        yield installation


@pytest.fixture(scope="session")
def undisturbed(local: Installation) -> Finished:
    """The main job, followed from submission to end."""
    job = local.client.submit(main_request(local))
    events = list(local.client.events(job.id))
    return Finished(local.client.job(job.id), events)


@pytest.fixture(
    scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)]
)
def installation(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Installation]:
    """A service and two workers; the URL alone tells the databases apart."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "sqlite":
        with installed(folder, settings=EAGER) as installation:
            yield installation
        return
    with (
        fresh_database(request.getfixturevalue("postgres_url")) as url,
        installed(folder, database_url=url, settings=EAGER) as installation,
    ):
        yield installation

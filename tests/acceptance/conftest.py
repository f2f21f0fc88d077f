"""One installation as users start it, and the main job that ran on it undisturbed."""

from collections.abc import Iterator

import pytest

from support.deployment import Installation, installed, without_settings
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

"""A real service for the clients; jobs are moved by hand in place of workers."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from prtbake import Client
from prtbake.cli.main import app
from prtbake_service.testing import LiveService, live_service, quick_settings
from prtbake_storage.contract.resources import EnvironmentRegistration


@pytest.fixture(autouse=True)
def _no_service_of_the_user(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for name in ("PRTBAKE_URL", "PRTBAKE_API_KEY", "PRTBAKE_DATA_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PRTBAKE_HOME", str(tmp_path_factory.mktemp("home")))


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    with live_service(quick_settings(tmp_path_factory.mktemp("client"))) as live:
        yield live


@pytest.fixture
def client(service: LiveService) -> Iterator[Client]:
    with Client(service.url, key=service.key) as client:
        yield client


@pytest.fixture(scope="session")
def environment(service: LiveService) -> str:
    """The id of an environment that has been parsed."""
    canonical = service.backend.blobs.put_bytes(b"sky")
    result = {"canonical": canonical, "understood": {"layout": "lat_long"}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    registration = EnvironmentRegistration.model_validate({"builtin": {"name": "sun_sky"}})
    with Client(service.url, key=service.key) as client:
        return client.register(registration).id


@pytest.fixture
def fit(environment: str) -> dict[str, Any]:
    """A request for a light fit."""
    return {"kind": "fit_light", "environment": environment}


@pytest.fixture
def run(service: LiveService) -> Callable[..., Result]:
    """Call the command line with the service's address and key."""

    def run_with(*arguments: object) -> Result:
        target = ["--url", service.url, "--key", service.key]
        return CliRunner().invoke(app, [*target, *map(str, arguments)])

    return run_with

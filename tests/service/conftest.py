"""One real service for all tests here; it has no workers, so jobs stay as the tests leave them."""

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from prtbake_service.testing import LiveService, live_service, quick_settings


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    with live_service(quick_settings(tmp_path_factory.mktemp("service"))) as live:
        yield live


@pytest.fixture(scope="session")
def http(service: LiveService) -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {service.key}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=20, trust_env=False) as http:
        yield http


@pytest.fixture(scope="session")
def environment(service: LiveService, http: httpx.Client) -> str:
    """The id of an environment that has been parsed."""
    return _parsed(service, http, "environments", {"builtin": {"name": "sun_sky"}})


@pytest.fixture(scope="session")
def mesh(service: LiveService, http: httpx.Client) -> str:
    """The id of a mesh that has been parsed."""
    return _parsed(service, http, "meshes", {"builtin": {"name": "icosphere", "tessellation": 2}})


def _parsed(service: LiveService, http: httpx.Client, path: str, body: dict[str, Any]) -> str:
    answer = http.post(f"/v1/{path}", json=body)
    assert answer.status_code == 202, answer.text
    resource = answer.json()["id"]
    canonical = service.backend.blobs.put_bytes(resource.encode())
    result = {"canonical": canonical, "understood": {"spec": {"model": "lambert"}, "n": 7}}
    service.succeed(f"parse-{resource}", result)
    return str(resource)


@pytest.fixture
def submit(http: httpx.Client, environment: str) -> Callable[..., dict[str, Any]]:
    """Submit a light fit with the fields given; returns the job."""

    def submit_fit(**fields: Any) -> dict[str, Any]:
        body = {"kind": "fit_light", "environment": environment} | fields
        answer = http.post("/v1/jobs", json=body)
        assert answer.status_code == 202, answer.text
        job: dict[str, Any] = answer.json()
        return job

    return submit_fit

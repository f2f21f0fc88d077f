"""Whatever comes in, it is answered with the caller's fault or with what was asked for."""

import json
from collections.abc import Iterator
from datetime import timedelta
from typing import Any
from urllib.parse import quote

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prtbake_service.app import create_app
from prtbake_service.errors_http import PROBLEM_JSON
from prtbake_service.settings import ServiceSettings
from prtbake_service.testing import LiveService, live_service, quick_settings
from prtbake_storage.contract.jobs import JobError, Problem
from prtbake_storage.records import NewJob
from prtbake_storage.testing.postgres import fresh_database
from support.openapi_strategies import values

DOCUMENT: dict[str, Any] = create_app(ServiceSettings()).openapi()
OPERATIONS = [
    (method, path, operation)
    for path, operations in DOCUMENT["paths"].items()
    if path.startswith("/v1/")
    for method, operation in operations.items()
]


@pytest.fixture(
    scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)]
)
def anywhere(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[LiveService]:
    """A service that waits for nothing, on each database."""
    folder = tmp_path_factory.mktemp("properties")
    short = {
        "parse_wait": timedelta(milliseconds=5),
        "long_poll_max": timedelta(milliseconds=5),
        "poll_every": timedelta(milliseconds=5),
    }
    if request.param == "sqlite":
        with live_service(quick_settings(folder, **short)) as live:
            yield live
        return
    with (
        fresh_database(request.getfixturevalue("postgres_url")) as url,
        live_service(quick_settings(folder, database_url=url, **short)) as live,
    ):
        yield live


@pytest.fixture(scope="module")
def calling(anywhere: LiveService) -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {anywhere.key}"}
    with httpx.Client(
        base_url=anywhere.url, headers=headers, timeout=20, trust_env=False
    ) as client:
        yield client


def requests(path: str, operation: dict[str, Any]) -> st.SearchStrategy[dict[str, Any]]:
    """What httpx is asked to send: path, query and body as the document has them, or nearly."""
    parameters = operation.get("parameters", [])
    placed = {
        place: st.fixed_dictionaries(
            {
                parameter["name"]: values(parameter["schema"], DOCUMENT)
                for parameter in parameters
                if parameter["in"] == place and parameter["name"] != "follow"
            }
        )
        for place in ("path", "query")
    }
    content = operation.get("requestBody", {}).get("content", {})
    body: st.SearchStrategy[Any] = st.none()
    if "application/json" in content:
        body = values(content["application/json"]["schema"], DOCUMENT)
    elif content:
        body = st.binary(max_size=20)

    def built(parts: tuple[dict[str, Any], dict[str, Any], Any]) -> dict[str, Any]:
        in_path, query, sent = parts
        filled = path.format(**{name: _quoted(value) for name, value in in_path.items()})
        pairs = [
            f"{name}={_quoted(item)}"
            for name, value in query.items()
            if value is not None
            for item in (value if isinstance(value, list) else [value])
        ]
        made: dict[str, Any] = {"url": "?".join([filled, "&".join(pairs)])}
        if isinstance(sent, bytes):
            made["content"] = sent
        elif "application/json" in content:
            made["content"] = json.dumps(sent).encode()
            made["headers"] = {"Content-Type": "application/json"}
        return made

    return st.tuples(placed["path"], placed["query"], body).map(built)


def _quoted(value: object) -> str:
    return quote(str(value), safe="", errors="surrogatepass")


REQUESTS = {(method, path): requests(path, operation) for method, path, operation in OPERATIONS}


@pytest.mark.parametrize(
    ("method", "path"),
    list(REQUESTS),
    ids=[f"{method} {path}" for method, path in REQUESTS],
)
@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data())
def test_no_request_is_our_fault(
    calling: httpx.Client, method: str, path: str, data: st.DataObject
) -> None:
    request = data.draw(REQUESTS[method, path])
    answer = calling.request(method.upper(), **request)
    assert answer.status_code < 500, (request, answer.text)
    if answer.status_code >= 400 and method != "head":
        assert answer.headers["content-type"] == PROBLEM_JSON
        assert Problem.model_validate_json(answer.content).status == answer.status_code


@pytest.mark.parametrize(
    "query",
    [
        "created_after=0001-01-01T00:00:00%2B14:00",
        "created_before=9999-12-31T23:59:59-14:00",
        "label=a%00b",
        # {"0001-01-01T00:00:00+14:00|x", "2026-01-01T00:00:00+00:00|\\0"} as cursors
        "cursor=MDAwMS0wMS0wMVQwMDowMDowMCsxNDowMHx4",
        "cursor=MjAyNi0wMS0wMVQwMDowMDowMCswMDowMHwA",
    ],
)
def test_filters_outside_what_databases_hold(calling: httpx.Client, query: str) -> None:
    answer = calling.get(f"/v1/jobs?{query}")
    assert answer.status_code in {400, 422}


def test_a_label_with_a_nul(calling: httpx.Client) -> None:
    for path, body in (
        ("/v1/meshes", {"builtin": {"name": "teapot"}}),
        ("/v1/jobs", {"kind": "fit_light", "environment": "environment-0000000000000000"}),
    ):
        answer = calling.post(path, json=body | {"label": "a\0b"})
        assert (answer.status_code, answer.json()["pointer"]) == (422, "/label")


@pytest.mark.parametrize("place", ["bake", "nothing"])
def test_half_a_character_as_a_name(calling: httpx.Client, place: str) -> None:
    body = {"kind": "asset", "settings": {place: {"\ud800": 1}}, "\ud801": 2}
    headers = {"Content-Type": "application/json"}
    answer = calling.post("/v1/jobs", content=json.dumps(body).encode(), headers=headers)
    assert answer.status_code == 422
    assert Problem.model_validate_json(answer.content).errors


@pytest.mark.parametrize("kind", ["estimate", "register"])
def test_the_services_own_jobs_are_not_retried(
    anywhere: LiveService, calling: httpx.Client, kind: str
) -> None:
    job = NewJob(id=f"own-{kind}", kind=kind, request={}, internal=True, quick=True)
    anywhere.backend.jobs.create(job)
    anywhere.fail(job.id, JobError(kind="internal", code="internal", detail="oh"))
    answer = calling.post(f"/v1/jobs/{job.id}/retry")
    assert (answer.status_code, answer.json()["code"]) == (409, "conflict")


def test_a_request_that_is_not_taken_any_more_is_not_retried(
    anywhere: LiveService, calling: httpx.Client
) -> None:
    request = {"kind": "fit_light", "environment": "environment-0000000000000000", "gone": 1}
    anywhere.backend.jobs.create(NewJob(id="of-old", kind="fit_light", request=request))
    anywhere.fail("of-old", JobError(kind="internal", code="internal", detail="oh"))
    answer = calling.post("/v1/jobs/of-old/retry")
    assert (answer.status_code, answer.json()["pointer"]) == (409, "/gone")

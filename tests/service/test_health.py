import shutil
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa

from prtbake_service.testing import LiveService, live_service, quick_settings
from prtbake_storage.testing.postgres import fresh_database


def get(service: LiveService, path: str) -> httpx.Response:
    return httpx.get(service.url + path, trust_env=False)


def test_health_needs_no_key(service: LiveService) -> None:
    assert get(service, "/healthz").json() == {"status": "ok"}
    ready = get(service, "/readyz")
    assert ready.status_code == 200
    assert ready.json() == {"status": "ready", "database": "ok", "blobs": "ok", "workers": 0}


def test_readiness_does_not_count_all_jobs(
    service: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def count() -> dict[str, int]:
        raise AssertionError("a probe comes every few seconds, and jobs are never few")

    monkeypatch.setattr(service.backend.jobs, "counts", count)
    assert get(service, "/readyz").status_code == 200


def test_workers_are_counted(service: LiveService) -> None:
    workers = service.backend.workers
    workers.beat("w-1", host="here", pid=1, tile_slots=1)
    workers.beat("w-2", host="here", pid=2, tile_slots=1)
    workers.mark_gone("w-2")
    assert get(service, "/readyz").json()["workers"] == 1
    assert "prtbake_workers_alive 1.0" in get(service, "/metrics").text
    workers.forget(["w-1", "w-2"])


def test_not_ready_without_blobs(tmp_path: Path) -> None:
    with live_service(quick_settings(tmp_path)) as live:
        shutil.rmtree(tmp_path / "blobs")
        (tmp_path / "blobs").write_text("in the way")
        answer = get(live, "/readyz")
        assert answer.status_code == 503
        assert answer.json()["blobs"] == "failed"
        assert answer.headers["retry-after"].isdigit()
        assert get(live, "/healthz").status_code == 200


def test_health_answers_while_every_thread_waits_for_the_database(tmp_path: Path) -> None:
    with live_service(quick_settings(tmp_path)) as live, ThreadPoolExecutor(60) as pool:
        writer = sqlite3.connect(tmp_path / "prtbake.sqlite", isolation_level=None)
        writer.execute("BEGIN IMMEDIATE")
        headers = {"Authorization": f"Bearer {live.key}"}
        body = {"builtin": {"name": "hall", "width": 32}}

        def register() -> int:
            url = f"{live.url}/v1/environments"
            answer = httpx.post(url, json=body, headers=headers, timeout=60, trust_env=False)
            return answer.status_code

        waiting = [pool.submit(register) for _ in range(60)]
        time.sleep(1.0)
        try:
            answer = httpx.get(f"{live.url}/healthz", timeout=5.0, trust_env=False)
        finally:
            writer.execute("ROLLBACK")
            writer.close()
        assert answer.status_code == 200
        assert {one.result() for one in waiting} == {202}


@pytest.mark.postgres
def test_a_database_that_is_away_is_said_to_be(postgres_url: str, tmp_path: Path) -> None:
    with (
        fresh_database(postgres_url) as url,
        live_service(quick_settings(tmp_path, database_url=url)) as live,
    ):
        outside = sa.create_engine(
            sa.make_url(postgres_url).set(drivername="postgresql+psycopg"),
            isolation_level="AUTOCOMMIT",
        )
        name = sa.make_url(url).database
        headers = {"Authorization": f"Bearer {live.key}"}
        with outside.connect() as connection:
            connection.execute(sa.text(f"ALTER DATABASE {name} ALLOW_CONNECTIONS false"))
            connection.execute(
                sa.text(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = :n"
                ),
                {"n": name},
            )
            away = httpx.get(f"{live.url}/v1/jobs", headers=headers, trust_env=False)
            ready = get(live, "/readyz")
            connection.execute(sa.text(f"ALTER DATABASE {name} ALLOW_CONNECTIONS true"))
        outside.dispose()
        assert (away.status_code, away.json()["code"]) == (503, "database-away")
        assert away.headers["retry-after"].isdigit()
        assert (ready.status_code, ready.json()["database"]) == (503, "failed")
        back = httpx.get(f"{live.url}/v1/jobs", headers=headers, trust_env=False)
        assert back.status_code == 200


def test_metrics(service: LiveService, http: httpx.Client, submit) -> None:
    submit()
    http.get("/v1/jobs/nothing-here")
    text = get(service, "/metrics").text
    # the template, not the path: a label for each job id would fill any memory
    assert 'route="/v1/jobs/{job_id}",status="404"' in text
    assert "nothing-here" not in text
    # nor does a made-up method become a label
    assert http.request("BREW", "/healthz").status_code == 405
    text = get(service, "/metrics").text
    assert 'method="other",route="/healthz",status="405"' in text
    assert "BREW" not in text
    assert 'prtbake_jobs{state="queued"}' in text
    assert "prtbake_http_request_seconds_bucket" in text


@pytest.mark.parametrize(
    "path", ["/", "/static/app.js", "/static/api.js", "/static/style.css", "/static/frontier.js"]
)
def test_the_page_and_its_parts(service: LiveService, path: str) -> None:
    answer = get(service, path)
    assert answer.status_code == 200
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_the_page_holds_no_secret_and_nothing_foreign(service: LiveService) -> None:
    answer = get(service, "/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert service.key not in answer.text
    for path in (
        "/",
        "/static/app.js",
        "/static/api.js",
        "/static/style.css",
        "/static/frontier.js",
    ):
        text = get(service, path).text
        assert "https://" not in text
        assert "innerHTML" not in text
        assert "set-cookie" not in get(service, path).headers


def test_openapi(service: LiveService) -> None:
    schema = get(service, "/v1/openapi.json").json()
    assert schema["openapi"].startswith("3.1")
    paths = schema["paths"]
    for path in ("/v1/jobs", "/v1/jobs:estimate", "/v1/jobs/{job_id}/events", "/v1/meshes"):
        assert path in paths
    operation = paths["/v1/jobs"]["post"]
    assert "application/problem+json" in operation["responses"]["4XX"]["content"]
    assert operation["security"]
    names = [o["operationId"] for p in paths.values() for o in p.values()]
    assert len(names) == len(set(names))
    refs = set(_refs(schema))
    assert {r.removeprefix("#/components/schemas/") for r in refs} <= set(
        schema["components"]["schemas"]
    )


def _refs(node: object):
    if isinstance(node, dict):
        for key, value in node.items():
            if key == "$ref":
                yield value
            else:
                yield from _refs(value)
    elif isinstance(node, list):
        for value in node:
            yield from _refs(value)

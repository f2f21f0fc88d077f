import hashlib
import threading
import time
from datetime import UTC, datetime, timedelta

import httpx
import pytest
import sqlalchemy as sa

from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import Job, JobError, JobPage, Progress
from prtbake_storage.contract.rates import NewRates
from prtbake_storage.queue.memo import Memory, recall, remember
from prtbake_storage.queue.reconcile import reconcile_once
from prtbake_storage.queue.stages import Measured
from prtbake_storage.records.cost_rates import learn
from prtbake_storage.records.models import CalibrationRow, JobRow
from support.rows import context_of

PATIENT = {"Prefer": "wait=30"}


def body_of(environment: str, **fields: object) -> dict[str, object]:
    return {"kind": "fit_light", "environment": environment} | fields


def test_submission_is_accepted_and_queued(service: LiveService, http, environment: str) -> None:
    answer = http.post("/v1/jobs", json=body_of(environment, label="hello", priority=3))
    assert answer.status_code == 202
    job = Job.model_validate_json(answer.content)
    assert job.state == "queued"
    assert job.label == "hello"
    assert answer.headers["location"] == f"/v1/jobs/{job.id}"
    assert answer.headers["retry-after"].isdigit()
    assert job.request["settings"]["n_lobes"] == 162  # defaults are spelled out
    assert service.backend.queue.statuses([job.id])
    context = context_of(service.backend.database, job.id)
    assert context["environment"]["id"] == environment
    assert context["environment"]["canonical"].startswith("sha256:")


def test_an_idempotency_key_makes_one_job(http, environment: str) -> None:
    headers = {"Idempotency-Key": "once-and-only"}
    first = http.post("/v1/jobs", json=body_of(environment), headers=headers)
    again = http.post("/v1/jobs", json=body_of(environment, seed=0), headers=headers)
    other = http.post("/v1/jobs", json=body_of(environment, seed=1), headers=headers)
    assert (first.status_code, again.status_code, other.status_code) == (202, 200, 409)
    assert again.json()["id"] == first.json()["id"]
    assert other.json()["code"] == "conflict"


def test_a_digest_of_an_earlier_version_still_names_its_request(
    service: LiveService, http, environment: str
) -> None:
    body = {"kind": "fit_light", "environment": environment, "settings": {"n_lobes": 33}}
    headers = {"Idempotency-Key": "before-the-upgrade"}
    first = http.post("/v1/jobs", json=body, headers=headers).json()
    # as one of before made it: of another spelling, without a field that is there now
    with service.backend.database.write() as session:
        row = session.get(JobRow, first["id"])
        row.body_digest = f"sha256:{'0' * 64}"
        row.request = {name: value for name, value in row.request.items() if name != "priority"}
    again = http.post("/v1/jobs", json=body, headers=headers)
    assert (again.status_code, again.json()["id"]) == (200, first["id"])
    # negative twin: another request
    other = http.post("/v1/jobs", json=body | {"settings": {"n_lobes": 34}}, headers=headers)
    assert other.status_code == 409


def test_a_key_names_what_was_given_whatever_defaults_become(
    service: LiveService, http, environment: str
) -> None:
    body = {"kind": "fit_light", "environment": environment, "settings": {"n_lobes": 35}}
    headers = {"Idempotency-Key": "defaults-change"}
    first = http.post("/v1/jobs", json=body, headers=headers).json()
    # a default of before
    with service.backend.database.write() as session:
        row = session.get(JobRow, first["id"])
        row.request = row.request | {"priority": 51}
    again = http.post("/v1/jobs", json=body, headers=headers)
    assert (again.status_code, again.json()["id"]) == (200, first["id"])
    # spelled out, today's default is another request than yesterday's
    assert http.post("/v1/jobs", json=body | {"priority": 50}, headers=headers).status_code == 409


def test_an_id_of_the_callers_choice(http, environment: str) -> None:
    first = http.put("/v1/jobs/my-own_job", json=body_of(environment))
    again = http.put("/v1/jobs/my-own_job", json=body_of(environment))
    other = http.put("/v1/jobs/my-own_job", json=body_of(environment, seed=1))
    assert (first.status_code, again.status_code, other.status_code) == (202, 200, 409)
    assert first.json()["id"] == "my-own_job"


@pytest.mark.parametrize("job_id", ["has.dot", "a" * 65, "with space"])
def test_ids_have_a_form(http, environment: str, job_id: str) -> None:
    assert http.put(f"/v1/jobs/{job_id}", json=body_of(environment)).status_code == 422


def test_no_caller_takes_the_services_ids(http, environment: str) -> None:
    answer = http.put("/v1/jobs/parse-mesh-0000000000000000", json=body_of(environment))
    assert answer.status_code == 400


def test_etag_and_304(service: LiveService, http, submit) -> None:
    job = submit()
    first = http.get(f"/v1/jobs/{job['id']}")
    etag = first.headers["etag"]
    assert etag.startswith('"')
    same = http.get(f"/v1/jobs/{job['id']}", headers={"If-None-Match": f'"x", W/{etag}'})
    assert same.status_code == 304
    assert same.content == b""
    assert same.headers["etag"] == etag
    service.begin(job["id"])
    changed = http.get(f"/v1/jobs/{job['id']}", headers={"If-None-Match": etag})
    assert changed.status_code == 200
    assert changed.headers["etag"] != etag


def test_long_poll_ends_with_the_change(service: LiveService, http, submit) -> None:
    job = submit()
    etag = http.get(f"/v1/jobs/{job['id']}").headers["etag"]
    headers = {"If-None-Match": etag}
    unchanged = http.get(f"/v1/jobs/{job['id']}?wait=0.1", headers=headers)
    assert unchanged.status_code == 304

    threading.Timer(0.15, service.begin, [job["id"]]).start()
    start = time.monotonic()
    changed = http.get(f"/v1/jobs/{job['id']}?wait=5", headers=headers)
    assert changed.json()["state"] == "running"
    assert time.monotonic() - start < 4


def test_long_poll_without_etag_waits_for_the_end(service: LiveService, http, submit) -> None:
    job = submit()
    service.begin(job["id"])
    assert http.get(f"/v1/jobs/{job['id']}?wait=0.1").json()["state"] == "running"
    threading.Timer(0.15, service.succeed, [job["id"], {}]).start()
    assert http.get(f"/v1/jobs/{job['id']}?wait=5").json()["state"] == "succeeded"


def test_estimate_answers_202_while_it_works(service: LiveService, http, environment: str) -> None:
    answer = http.post("/v1/jobs:estimate", json=body_of(environment))
    assert answer.status_code == 202
    job = answer.json()
    assert job["kind"] == "estimate"
    assert job["request"]["request"]["kind"] == "fit_light"
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert job["id"] not in [item["id"] for item in http.get("/v1/jobs?limit=100").json()["items"]]


def test_jobs_and_estimates_are_given_the_rates_that_count(
    service: LiveService, http, environment: str
) -> None:
    def given(path: str) -> dict[str, object]:
        answer = http.post(path, json=body_of(environment))
        return context_of(service.backend.database, answer.json()["id"])

    shipped = {"seconds": None, "factors": {}, "calibration": None}
    assert given("/v1/jobs")["rates"] == shipped
    estimated = given("/v1/jobs:estimate")
    assert estimated["rates"] == shipped
    assert estimated["tile_slots"] == service.backend.tile_slots()
    with service.backend.database.write() as session:
        learn(session, "calibrate-x", NewRates(seconds={"join": {"tasks": 3.0}}))
    try:
        assert given("/v1/jobs:estimate")["rates"] == shipped | {
            "seconds": {"join": {"tasks": 3.0}}, "calibration": "calibrate-x",
        }  # fmt: skip
    finally:
        with service.backend.database.write() as session:
            session.execute(sa.delete(CalibrationRow))


def test_no_two_calibrations_time_the_same_tasks(service: LiveService, http) -> None:
    nonces = set()
    for _ in range(2):
        answer = http.post("/v1/jobs", json={"kind": "calibrate"})
        assert answer.status_code == 202, answer.text
        nonces.add(context_of(service.backend.database, answer.json()["id"])["nonce"])
    assert len(nonces) == 2
    answer = http.post("/v1/jobs", json={"kind": "calibrate", "mesh": "mesh-0000000000000000"})
    assert answer.status_code == 422


def test_estimate_gives_what_the_worker_found(service: LiveService, http, environment: str) -> None:
    estimate = {
        "plan": {},
        "seconds": {"fit": 2.0},
        "total_seconds": 2.0,
        "artefact_bytes": {"light.h5": 1000},
        "artefact_bytes_at_most": {},
        "peak_memory_bytes": 5,
        "errors": {},
        "warnings": [],
    }
    service.answer_next("estimate", lambda job: service.succeed(job, estimate))
    answer = http.post("/v1/jobs:estimate", json=body_of(environment), headers=PATIENT)
    assert answer.status_code == 200
    assert answer.json() == estimate


@pytest.mark.parametrize(("kind", "status"), [("input", 400), ("resource", 503), ("internal", 500)])
def test_estimate_passes_a_refusal_on(
    service: LiveService, http, environment: str, kind, status: int
) -> None:
    error = JobError(kind=kind, code="bad-plan", detail="ranks too large", pointer="/settings")
    service.answer_next("estimate", lambda job: service.fail(job, error))
    answer = http.post("/v1/jobs:estimate", json=body_of(environment), headers=PATIENT)
    assert answer.status_code == status
    problem = answer.json()
    assert (problem["code"], problem["detail"]) == ("bad-plan", "ranks too large")
    assert problem["pointer"] == "/settings"


def test_cancel_is_idempotent(service: LiveService, http, submit) -> None:
    job = submit()
    first = http.post(f"/v1/jobs/{job['id']}/cancel")
    assert (first.status_code, first.json()["state"]) == (202, "canceled")
    again = http.post(f"/v1/jobs/{job['id']}/cancel")
    assert (again.status_code, again.json()["state"]) == (202, "canceled")
    statuses = service.backend.queue.statuses([job["id"]])
    assert statuses[job["id"]] == "CANCELLED"


def test_cancel_of_a_running_job_is_a_request(service: LiveService, http, submit) -> None:
    job = submit()
    service.begin(job["id"])
    assert http.post(f"/v1/jobs/{job['id']}/cancel").json()["state"] == "cancel_requested"


def test_retry_is_a_new_job(service: LiveService, http, submit) -> None:
    job = submit(label="again")
    assert http.post(f"/v1/jobs/{job['id']}/retry").status_code == 409
    service.fail(job["id"], JobError(kind="internal", code="internal", detail="oh"))
    answer = http.post(f"/v1/jobs/{job['id']}/retry", headers={"Idempotency-Key": "retry-1"})
    assert answer.status_code == 202
    retried = answer.json()
    assert retried["retry_of"] == job["id"]
    assert retried["id"] != job["id"]
    assert retried["request"] == job["request"]
    again = http.post(f"/v1/jobs/{job['id']}/retry", headers={"Idempotency-Key": "retry-1"})
    assert (again.status_code, again.json()["id"]) == (200, retried["id"])
    assert http.get(f"/v1/jobs/{job['id']}").json()["error"]["detail"] == "oh"


def test_a_success_is_not_retried(service: LiveService, http, submit) -> None:
    job = submit()
    service.succeed(job["id"], {})
    assert http.post(f"/v1/jobs/{job['id']}/retry").status_code == 409


def test_delete_leaves_the_files_that_another_job_recalled(
    service: LiveService, http, submit
) -> None:
    job, other = submit(), submit()
    assert http.delete(f"/v1/jobs/{job['id']}").status_code == 409
    service.succeed(job["id"], {}, shared_bin=b"shared")
    # the other job recalls the task that made the file: no row says so before its end
    service.begin(other["id"])
    blobs = service.backend.blobs
    (artefact,) = service.backend.jobs.get(job["id"]).artefacts
    key = hashlib.sha256(job["id"].encode()).hexdigest()
    remember(blobs, key, Memory({"file": artefact.sha256}, Measured(1.0, 1)))
    recalled = recall(blobs, key)
    assert recalled is not None

    assert http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    assert http.get(f"/v1/jobs/{job['id']}").status_code == 404
    assert http.get(f"/v1/jobs/{job['id']}/artefacts/shared.bin").status_code == 404
    assert http.delete(f"/v1/jobs/{job['id']}").status_code == 404
    assert blobs.read_bytes(recalled.result["file"]) == b"shared"


def test_an_id_can_be_used_again_after_delete(service: LiveService, http, environment: str) -> None:
    http.put("/v1/jobs/phoenix", json=body_of(environment))
    http.post("/v1/jobs/phoenix/cancel")
    assert http.delete("/v1/jobs/phoenix").status_code == 204
    assert http.put("/v1/jobs/phoenix", json=body_of(environment)).status_code == 202
    assert service.backend.queue.statuses(["phoenix"]) == {"phoenix": "ENQUEUED"}


def test_an_id_whose_deletion_was_cut_short_can_be_used_again(
    service: LiveService, http, environment: str
) -> None:
    http.put("/v1/jobs/half-gone", json=body_of(environment))
    http.post("/v1/jobs/half-gone/cancel")
    service.backend.jobs.delete("half-gone")  # and the process dies before the engine is told
    assert service.backend.queue.statuses(["half-gone"]) == {"half-gone": "CANCELLED"}
    assert http.put("/v1/jobs/half-gone", json=body_of(environment, seed=5)).status_code == 202
    reconcile_once(service.backend.database, service.backend.queue)
    assert http.get("/v1/jobs/half-gone").json()["state"] == "queued"
    assert service.backend.queue.statuses(["half-gone"]) == {"half-gone": "ENQUEUED"}


def test_lists_page_in_a_stable_order(http, submit) -> None:
    made = [submit(label="paged")["id"] for _ in range(5)]
    seen: list[str] = []
    cursor = None
    for _ in range(3):
        params = {"label": "paged", "limit": 2} | ({"cursor": cursor} if cursor else {})
        page = JobPage.model_validate_json(http.get("/v1/jobs", params=params).content)
        seen += [job.id for job in page.items]
        if not cursor:
            submit(label="paged")  # what comes in between disturbs no page
        cursor = page.next
    assert cursor is None
    assert seen == made[::-1]


def test_filters(service: LiveService, http, submit) -> None:
    before = datetime.now(UTC)
    job = submit(label="filtered")
    service.begin(job["id"])
    service.runs.progress(job["id"], Progress(stage="fit", fraction=0.5))

    def found(**params: object) -> bool:
        page = http.get("/v1/jobs", params={"limit": 100, "label": "filtered"} | params).json()
        return job["id"] in [item["id"] for item in page["items"]]

    assert found(state=["running", "failed"])
    assert not found(state="queued")
    assert found(kind="fit_light")
    assert not found(kind=["bake", "asset"])
    assert found(created_after=before.isoformat())
    assert not found(created_before=before.isoformat())
    assert found(created_before=(before + timedelta(hours=1)).isoformat())
    assert http.get("/v1/jobs?created_after=2026-01-01T00:00:00").status_code == 422


def test_a_submission_survives_an_engine_that_is_down(
    service: LiveService, http, environment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ConnectionError("the engine's database is away")

    with monkeypatch.context() as patched:
        patched.setattr(service.backend.queue, "submit", fail)
        answer = http.put("/v1/jobs/orphan", json=body_of(environment))
    assert answer.status_code == 202
    assert not service.backend.queue.statuses(["orphan"])
    reconcile_once(service.backend.database, service.backend.queue)
    assert service.backend.queue.statuses(["orphan"])


def test_304_for_a_job_that_is_gone_is_a_404(http: httpx.Client) -> None:
    answer = http.get("/v1/jobs/never-was?wait=1", headers={"If-None-Match": "*"})
    assert answer.status_code == 404

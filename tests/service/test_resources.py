import httpx
import pytest

from prtbake_service.jobs.service import QUICK_TIMEOUT_S
from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import JobError
from prtbake_storage.contract.resources import Resource, ResourcePage
from prtbake_storage.records.models import JobRow

PATIENT = {"Prefer": "respond-async, wait=30"}
SKY = {"builtin": {"name": "sun_sky", "width": 32}}


def test_registration_goes_on_behind_a_202(service: LiveService, http: httpx.Client) -> None:
    answer = http.post("/v1/environments", json=SKY)
    assert answer.status_code == 202
    resource = Resource.model_validate_json(answer.content)
    path = f"/v1/environments/{resource.id}"
    assert answer.headers["location"] == path
    assert answer.headers["retry-after"].isdigit()
    job = service.backend.jobs.get(f"parse-{resource.id}")
    assert job.request["resource_kind"] == "environment"
    assert job.request["registration"]["builtin"]["width"] == 32

    again = http.post("/v1/environments", json=SKY | {"label": "another name"})
    assert (again.status_code, again.json()["id"]) == (202, resource.id)

    canonical = service.backend.blobs.put_bytes(b"canonical")
    result = {"canonical": canonical, "understood": {"layout": "lat_long"}}
    service.succeed(job.id, result)
    found = http.get(path, params={"wait": 1}).json()
    assert (found["state"], found["canonical"]) == ("ready", canonical)
    assert found["understood"] == {"layout": "lat_long"}
    ready = http.post("/v1/environments", json=SKY)
    assert (ready.status_code, ready.json()["id"]) == (200, resource.id)


def test_parsing_and_estimates_have_a_wall_clock(
    service: LiveService, http: httpx.Client, environment: str
) -> None:
    body = {"builtin": {"name": "hall", "width": 48}}
    parsing = "parse-" + http.post("/v1/environments", json=body).json()["id"]
    request = {"kind": "fit_light", "environment": environment}
    estimate = http.post("/v1/jobs:estimate", json=request).json()["id"]
    with service.backend.database.read() as session:
        for job in (parsing, estimate):
            assert session.get_one(JobRow, job).timeout_s == QUICK_TIMEOUT_S


def test_a_quick_worker_makes_it_a_201(service: LiveService, http: httpx.Client) -> None:
    # in no other file: they share the service, in whatever order they run
    body = {"spec": {"model": "ggx", "alpha": 0.3017}}
    canonical = service.backend.blobs.put_bytes(b"{}")
    result = {"canonical": canonical, "understood": {"spec": body["spec"]}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    answer = http.post("/v1/brdfs", json=body, headers=PATIENT)
    assert answer.status_code == 201
    assert answer.json()["understood"] == {"spec": body["spec"]}


def test_a_refusal_says_what_and_where(service: LiveService, http: httpx.Client) -> None:
    digest = service.backend.blobs.put_bytes(b"no mesh")
    service.backend.uploads.add(digest, 7)
    body = {"blob": digest, "filename": "no.obj"}
    error = JobError(kind="input", code="invalid-mesh", detail="vertex 3 is NaN", pointer="/blob")
    service.answer_next("register", lambda job: service.fail(job, error))
    answer = http.post("/v1/meshes", json=body, headers=PATIENT)
    assert answer.status_code == 400
    problem = answer.json()
    assert (problem["code"], problem["detail"]) == ("invalid-mesh", "vertex 3 is NaN")
    assert problem["pointer"] == "/blob"
    # once more: the parser may have learned
    canonical = service.backend.blobs.put_bytes(b"mesh")
    result = {"canonical": canonical, "understood": {}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    again = http.post("/v1/meshes", json=body, headers=PATIENT)
    assert again.status_code == 200
    assert again.json()["state"] == "ready"
    assert again.json()["problem"] is None


def test_a_resource_whose_file_is_gone_is_parsed_again(
    service: LiveService, http: httpx.Client
) -> None:
    body = {"builtin": {"name": "constant", "width": 16}}
    made = http.post("/v1/environments", json=body).json()["id"]
    canonical = service.backend.blobs.put_bytes(b"a constant sky")
    service.succeed(f"parse-{made}", {"canonical": canonical, "understood": {}})
    assert http.post("/v1/environments", json=body).status_code == 200
    service.backend.blobs.delete(canonical)
    fit = {"kind": "fit_light", "environment": made}
    answer = http.post("/v1/jobs", json=fit)
    assert (answer.status_code, answer.json()["pointer"]) == (409, "/environment")
    assert "register it again" in answer.json()["detail"]

    def parse(job: str) -> None:
        again = service.backend.blobs.put_bytes(b"a constant sky")
        service.succeed(job, {"canonical": again, "understood": {}})

    service.answer_next("register", parse)
    assert http.post("/v1/environments", json=body, headers=PATIENT).status_code == 200
    assert http.post("/v1/jobs", json=fit).status_code == 202


@pytest.mark.parametrize(("code", "width"), [("cpu-limit", 160), ("out-of-memory", 192)])
def test_a_file_that_takes_too_much_is_too_large(
    service: LiveService, http: httpx.Client, code: str, width: int
) -> None:
    body = {"builtin": {"name": "hall", "width": width}}
    error = JobError(kind="input", code=code, detail="parsing needs more than it may")
    service.answer_next("register", lambda job: service.fail(job, error))
    answer = http.post("/v1/environments", json=body, headers=PATIENT)
    assert (answer.status_code, answer.json()["code"]) == (413, code)
    assert "retry-after" not in answer.headers  # the same file would take as much again


@pytest.mark.parametrize(("kind", "status"), [("resource", 503), ("internal", 500)])
def test_a_fault_of_ours_is_no_refusal(service: LiveService, http, kind, status: int) -> None:
    body = {"builtin": {"name": "hall", "width": 64 if kind == "resource" else 128}}
    code = "out-of-memory" if kind == "resource" else "oops"
    error = JobError(kind=kind, code=code, detail="this machine has no memory left")
    service.answer_next("register", lambda job: service.fail(job, error))
    answer = http.post("/v1/environments", json=body, headers=PATIENT)
    assert answer.status_code == status
    assert ("retry-after" in answer.headers) == (status == 503)


def test_the_blob_must_be_there(http: httpx.Client) -> None:
    answer = http.post("/v1/meshes", json={"blob": "sha256:" + "2" * 64})
    assert (answer.status_code, answer.json()["pointer"]) == (404, "/blob")


@pytest.mark.parametrize(
    "body", [{}, {"blob": "sha256:" + "2" * 64, "builtin": {"name": "teapot"}}, {"format": "fbx"}]
)
def test_one_source(http: httpx.Client, body: dict[str, object]) -> None:
    assert http.post("/v1/meshes", json=body).status_code == 422


def test_kinds_do_not_mix(http: httpx.Client, mesh: str, environment: str) -> None:
    assert http.get(f"/v1/meshes/{mesh}").status_code == 200
    assert http.get(f"/v1/environments/{mesh}").status_code == 404
    assert http.get(f"/v1/meshes/{environment}").status_code == 404


def test_lists_are_paged(http: httpx.Client) -> None:
    for n in (3, 4, 5):
        http.post("/v1/meshes", json={"builtin": {"name": "teapot", "tessellation": n}})
    seen: list[str] = []
    cursor: str | None = None
    while True:
        params = {"limit": 2} | ({"cursor": cursor} if cursor else {})
        page = ResourcePage.model_validate_json(http.get("/v1/meshes", params=params).content)
        assert len(page.items) <= 2
        seen += [item.id for item in page.items]
        cursor = page.next
        if cursor is None:
            break
    assert len(seen) == len(set(seen)) >= 3
    assert all(name.startswith("mesh-") for name in seen)


def test_each_registration_has_a_body_of_its_own_type(http: httpx.Client) -> None:
    paths = http.get("/v1/openapi.json").json()["paths"]
    for noun, body in (
        ("meshes", "MeshRegistration"),
        ("brdfs", "BrdfRegistration"),
        ("environments", "EnvironmentRegistration"),
    ):
        operation = paths[f"/v1/{noun}"]["post"]
        schema = operation["requestBody"]["content"]["application/json"]["schema"]
        assert schema == {"$ref": f"#/components/schemas/{body}"}
        assert [parameter["name"] for parameter in operation["parameters"]] == ["prefer"]
        assert {"200", "201", "202"} <= set(operation["responses"])

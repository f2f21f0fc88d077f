"""Every error is problem+json with a code and, where there is one, a pointer to the field."""

from typing import Any

import httpx
import pytest

from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import Problem

PROBLEM = "application/problem+json"


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/nowhere", 404, "not-found"),
        ("GET", "/v1/nowhere", 404, "not-found"),
        ("GET", "/static/nothing.js", 404, "not-found"),
        ("PATCH", "/v1/jobs", 405, "method-not-allowed"),
        ("GET", "/v1/jobs/none", 404, "not-found"),
        ("GET", "/v1/jobs?limit=0", 422, "malformed-request"),
        ("GET", "/v1/jobs?cursor=zzz", 400, "invalid-input"),
        ("GET", "/v1/jobs?state=sleeping", 422, "malformed-request"),
        ("PUT", "/v1/uploads/sha256:short", 422, "malformed-request"),
        ("GET", "/v1/meshes/mesh-0000000000000000", 404, "not-found"),
        ("GET", "/v1/jobs/none/artefacts/x.png", 404, "not-found"),
    ],
)
def test_all_errors_are_problems(
    http: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    answer = http.request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == PROBLEM
    problem = Problem.model_validate_json(answer.content)
    assert (problem.status, problem.code) == (status, code)
    assert problem.detail
    assert answer.headers["x-request-id"]


def test_405_names_the_methods(http: httpx.Client) -> None:
    assert "GET" in http.patch("/v1/jobs").headers["allow"]


def test_a_malformed_request_names_every_field(http: httpx.Client) -> None:
    body = {"kind": "asset", "mesh": "x", "brdf": {"model": "lambert", "albedo": 2}, "extra": 1}
    problem = http.post("/v1/jobs", json=body).json()
    assert problem["status"] == 422
    pointers = {entry["pointer"] for entry in problem["errors"]}
    assert {"/mesh", "/environment", "/extra"} <= pointers
    assert any(pointer.startswith("/brdf") for pointer in pointers)
    assert problem["pointer"] in pointers


def test_settings_of_a_stage_are_checked(http: httpx.Client, mesh: str, environment: str) -> None:
    body = {
        "kind": "asset",
        "mesh": mesh,
        "environment": environment,
        "brdf": {"model": "lambert"},
        "settings": {"bake": {"n_terms": 0}, "compress": {"rank": [1, 1, 1]}},
    }
    problem = http.post("/v1/jobs", json=body).json()
    assert problem["status"] == 422
    assert {entry["pointer"] for entry in problem["errors"]} == {
        "/settings/bake/n_terms",
        "/settings/compress/rank",
    }


@pytest.mark.parametrize("stage", ["render", "validation"])
def test_two_cameras_of_one_name_are_refused(
    http: httpx.Client, mesh: str, environment: str, stage: str
) -> None:
    """Their pictures would be two files of one name, found out when all work is done."""
    body = {
        "kind": "asset",
        "mesh": mesh,
        "environment": environment,
        "brdf": {"model": "lambert"},
        "settings": {stage: {"cameras": [{"azimuth_deg": 0}, {"azimuth_deg": 90}]}},
    }
    problem = http.post("/v1/jobs", json=body).json()
    assert (problem["status"], problem["pointer"]) == (422, f"/settings/{stage}/cameras")
    assert "cameras 0 and 1 are both called 'front'" in problem["detail"]
    body["settings"] = {stage: {"cameras": [{"azimuth_deg": 0}, {"name": "side"}]}}
    assert http.post("/v1/jobs", json=body).status_code == 202


TOO_MUCH = [
    ("render", "turntable_frames", {"width": 4096, "height": 4096, "turntable_frames": 33}),
    ("validation", "passes", {"width": 2048, "height": 2048, "passes": 9}),
    (
        "validation",
        "rotations_deg",
        {"width": 2048, "height": 2048, "rotations_deg": [[0, 0, 0]] * 2},
    ),
]
"""Each field by itself is legal; together they would take 1.7 GB of frames, 3.6 and 6.4 GB."""


@pytest.mark.parametrize(("stage", "field", "settings"), TOO_MUCH)
def test_settings_that_ask_too_much_together_are_refused(
    http: httpx.Client,
    mesh: str,
    environment: str,
    stage: str,
    field: str,
    settings: dict[str, Any],
) -> None:
    body = {
        "kind": "asset",
        "mesh": mesh,
        "environment": environment,
        "brdf": {"model": "lambert"},
        "settings": {stage: settings},
    }
    problem = http.post("/v1/jobs", json=body).json()
    assert (problem["status"], problem["pointer"]) == (422, f"/settings/{stage}/{field}")
    assert (
        f"width x height x {'turntable_frames' if stage == 'render' else 'passes'}"
        in problem["detail"]
    )
    # one less of it is taken
    settings = dict(settings)
    settings[field] = (
        settings[field][1:] if isinstance(settings[field], list) else settings[field] - 1
    )
    assert http.post("/v1/jobs", json=body | {"settings": {stage: settings}}).status_code == 202


def test_broken_json_is_malformed(http: httpx.Client) -> None:
    headers = {"Content-Type": "application/json"}
    answer = http.post("/v1/jobs", content=b'{"kind": ', headers=headers)
    assert answer.status_code == 422
    assert "not JSON" in answer.json()["detail"]


def test_infinity_is_refused(http: httpx.Client, environment: str) -> None:
    headers = {"Content-Type": "application/json"}
    body = f'{{"kind": "fit_light", "environment": "{environment}", "seed": 1e999}}'
    assert http.post("/v1/jobs", content=body.encode(), headers=headers).status_code == 422


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_has_a_limit(http: httpx.Client, service: LiveService, chunked: bool) -> None:
    limit = service.backend.settings.max_request_bytes
    body = b" " * (limit + 1)
    content = iter([body[:100], body[100:]]) if chunked else body
    headers = {"Content-Type": "application/json"}
    answer = http.post("/v1/jobs", content=content, headers=headers)
    assert answer.status_code == 413
    assert answer.headers["content-type"] == PROBLEM
    assert str(limit) in answer.json()["detail"]


def test_faults_of_ours_tell_nothing_but_an_id(
    http: httpx.Client, service: LiveService, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(*_: object, **__: object) -> None:
        raise RuntimeError("the password is swordfish")

    monkeypatch.setattr(type(service.backend.jobs), "page", explode)
    answer = http.get("/v1/jobs", headers={"X-Request-ID": "abc-1"})
    assert answer.status_code == 500
    assert answer.headers["content-type"] == PROBLEM
    assert answer.headers["x-request-id"] == "abc-1"
    assert "swordfish" not in answer.text
    assert answer.json()["code"] == "internal"


def test_a_strange_request_id_is_replaced(http: httpx.Client) -> None:
    answer = http.get("/healthz", headers={"X-Request-ID": "a b{}"})
    assert answer.headers["x-request-id"] != "a b{}"

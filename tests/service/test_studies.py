"""Studies as the service takes them: references of every point, and what it refuses."""

from typing import Any

import httpx
import pytest

from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import job_request_adapter
from support.rows import context_of

LAMBERT = {"model": "lambert", "albedo": 0.5}


@pytest.fixture
def transfer(service: LiveService, submit: Any) -> str:
    job = submit()
    service.succeed(job["id"], {}, transfer_h5=b"T")
    return f"{job['id']}/transfer.h5"


def study(base: dict[str, Any], axes: Any, **fields: Any) -> dict[str, Any]:
    return {"kind": "study", "base": base, "axes": axes, **fields}


def test_points_that_name_the_same_share_a_context(
    service: LiveService, http: httpx.Client, transfer: str
) -> None:
    base = {"kind": "compress", "transfer": transfer}
    axes = {"settings.n_clusters": [2, 4], "seed": [0, 1]}
    answer = http.post("/v1/jobs", json=study(base, axes, label="two by two"))
    assert answer.status_code == 202, answer.text
    assert answer.json()["label"] == "two by two"
    # only what was given: some defaults would stand in an axis's way
    assert answer.json()["request"]["base"]["settings"] == {}
    context = context_of(service.backend.database, answer.json()["id"])
    assert len(context["contexts"]) == 1
    assert context["points"] == [{"context": 0}] * 4
    (item,) = http.get("/v1/jobs?kind=study&limit=1").json()["items"]
    assert item["id"] == answer.json()["id"]


def test_what_a_study_was_given_holds_no_default() -> None:
    """Its idempotency digest is of that: defaults are another version's."""
    base = {"kind": "compress", "transfer": "job/transfer.h5", "settings": {"bits": 8}}
    given = study(base, {"settings.n_clusters": [2, 4]})
    request = job_request_adapter.validate_python(given)
    axes = [{"path": "settings.n_clusters", "values": [2, 4]}]
    assert request.model_dump(mode="json", exclude_unset=True) == given | {"axes": axes}
    assert request.model_dump(mode="json")["base"]["seed"] == 0


def test_points_that_name_others_have_their_own(
    service: LiveService, http: httpx.Client, mesh: str
) -> None:
    base = {"kind": "bake", "mesh": mesh, "brdf": LAMBERT}
    axes = {"settings.cube_resolution": [8, 12], "brdf.albedo": [0.2, 0.8]}
    made = http.post("/v1/jobs", json=study(base, axes)).json()
    context = context_of(service.backend.database, made["id"])
    assert [place["context"] for place in context["points"]] == [0, 1, 0, 1]
    albedos = [own["brdf"]["spec"]["albedo"] for own in context["contexts"]]
    assert albedos == [0.2, 0.8]


def test_illegal_axes_are_named(http: httpx.Client, mesh: str) -> None:
    base = {"kind": "bake", "mesh": mesh, "brdf": LAMBERT}
    axes = {"settings.basis": ["sh", "srbf"], "settings.n_centres": [42, 162]}
    for path in ("/v1/jobs", "/v1/jobs:estimate"):
        answer = http.post(path, json=study(base, axes))
        problem = answer.json()
        assert (answer.status_code, problem["pointer"]) == (422, "/axes")
        assert 'settings.basis = "sh", settings.n_centres = 42' in problem["detail"]
    answer = http.post("/v1/jobs", json=study(base, axes, skip_illegal=True))
    assert answer.status_code == 202


def test_what_the_references_forbid(service: LiveService, http: httpx.Client, mesh: str) -> None:
    """A texture goes with Lambert alone: two points of three."""
    texture = service.backend.blobs.put_bytes(b"a third picture")
    service.backend.uploads.add(texture, 15)
    base = {"kind": "bake", "mesh": mesh, "brdf": LAMBERT, "albedo_texture": texture}
    axes = {"brdf": [{"model": "ggx"}, LAMBERT, {"model": "lambert", "albedo": 0.1}]}
    answer = http.post("/v1/jobs", json=study(base, axes))
    assert (answer.status_code, answer.json()["pointer"]) == (400, "/base/albedo_texture")
    assert '"ggx"' in answer.json()["detail"]
    made = http.post("/v1/jobs", json=study(base, axes, skip_illegal=True)).json()
    context = context_of(service.backend.database, made["id"])
    assert "lambert" in context["points"][0]["refused"]
    assert [place.get("context") for place in context["points"]] == [None, 0, 1]
    alone = study(base, {"brdf": axes["brdf"][:1]}, skip_illegal=True)
    answer = http.post("/v1/jobs", json=alone)
    assert (answer.status_code, answer.json()["pointer"]) == (400, "/axes")


def test_what_is_not_there_is_never_skipped(http: httpx.Client, transfer: str) -> None:
    base = {"kind": "compress", "transfer": transfer}
    axes = {"transfer": [transfer, "no-such-job/transfer.h5"]}
    answer = http.post("/v1/jobs", json=study(base, axes, skip_illegal=True))
    assert (answer.status_code, answer.json()["pointer"]) == (404, "/base/transfer")
    assert "no-such-job" in answer.json()["detail"]


def test_a_study_is_retried_as_it_was(
    service: LiveService, http: httpx.Client, transfer: str
) -> None:
    base = {"kind": "compress", "transfer": transfer}
    made = http.post("/v1/jobs", json=study(base, {"seed": [1, 2]})).json()
    http.post(f"/v1/jobs/{made['id']}/cancel")
    again = http.post(f"/v1/jobs/{made['id']}/retry")
    assert again.status_code == 202
    assert again.json()["retry_of"] == made["id"]
    assert again.json()["request"] == made["request"]
    old, new = (context_of(service.backend.database, one["id"]) for one in (made, again.json()))
    assert old == new


def test_the_page_can_draw_the_plot(service: LiveService, http: httpx.Client) -> None:
    answer = http.get("/static/frontier.js")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/javascript")
    assert "export function drawFrontier" in answer.text
    assert "innerHTML" not in answer.text
    assert "https://" not in answer.text
    assert '"/static/frontier.js"' in http.get("/static/app.js").text

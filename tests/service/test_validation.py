"""Errors of the models as pointers that hold field names and indices only, and their sentences."""

from typing import Any

import httpx
import pytest
from pydantic import ValidationError

from prtbake_service.validation import pointer_to, validation_entries
from prtbake_storage.contract.jobs import job_request_adapter


@pytest.mark.parametrize(
    ("loc", "body", "pointer"),
    [
        # the tag of the union is not in the body
        (
            ["asset", "settings", "bake"],
            {"kind": "asset", "settings": {"bake": 3}},
            "/settings/bake",
        ),
        # a field of the name of the tag is
        (["render", "asset"], {"kind": "render", "asset": 1}, "/asset"),
        (["asset", "asset"], {"kind": "asset", "asset": 1}, "/asset"),
        # a missing field is the last step
        (["asset", "mesh"], {"kind": "asset"}, "/mesh"),
        (
            ["bake", "brdf", "lambert", "albedo"],
            {"kind": "bake", "brdf": {"albedo": 2}},
            "/brdf/albedo",
        ),
        (["a", 1, "b"], {"a": [{}, {"b": 0}]}, "/a/1/b"),
        (["a/b~c"], {"a/b~c": 0}, "/a~1b~0c"),
        ([], {}, ""),
    ],
)
def test_pointers(loc: list[str | int], body: object, pointer: str) -> None:
    assert pointer_to(loc, body, missing=True) == pointer


@pytest.mark.parametrize(
    ("fields", "pointer"),
    [
        (
            {"kind": "bake", "settings": {"n_centres": 42, "term_energy_lost": 0.01}},
            "/settings/term_energy_lost",
        ),
        (
            {
                "kind": "asset",
                "environment": "environment-0000000000000000",
                "settings": {"bake": {"n_centres": 42}, "compress": {"ranks": [2, 4, 4]}},
            },
            "/settings/compress/ranks",
        ),
    ],
)
def test_a_setting_that_a_budget_decides_is_pointed_at(
    fields: dict[str, Any], pointer: str
) -> None:
    body = {"mesh": "mesh-0000000000000000", "brdf": {"model": "lambert"}} | fields
    body["budget"] = {"max_error": 0.1}
    with pytest.raises(ValidationError) as refused:
        job_request_adapter.validate_python(body)
    (entry,) = validation_entries(refused.value.errors(), body)
    assert entry["pointer"] == pointer
    assert "chooses" in entry["detail"]


def test_what_a_union_tried_is_no_step() -> None:
    body = {"kind": "asset", "brdf": {"model": "ggx"}}
    assert pointer_to(["asset", "brdf", "constrained-str"], body) == "/brdf"
    assert pointer_to(["asset", "brdf", "mesh"], body, missing=True) == "/brdf/mesh"


def test_alternatives_of_a_union_are_one_entry() -> None:
    errors = [
        {"loc": ("body", "brdf", "str"), "msg": "not a string", "type": "string_type"},
        {"loc": ("body", "brdf", "lambert"), "msg": "not a list", "type": "list_type"},
    ]
    entries = validation_entries(errors, {"brdf": 3})
    assert [entry["pointer"] for entry in entries] == ["/brdf"]
    assert "not a string; or: not a list" in entries[0]["detail"]


@pytest.mark.parametrize(
    ("change", "pointer", "said"),
    [
        # an object means the tagged union, and its model the member
        ({"brdf": {"model": "cook_torrance", "m": -1}}, "/brdf/m", "greater than or equal to 0.01"),
        ({"brdf": {"model": "ggxx"}}, "/brdf/model", "'ggxx' is none of 'lambert', 'phong'"),
        ({"brdf": {"m": 1}}, "/brdf/model", "Field required"),
        ({"brdf": {"model": "lambert", "colour": 1}}, "/brdf/colour", "Extra inputs"),
        # a string means an id
        ({"brdf": "gold"}, "/brdf", "should match pattern"),
        # a number means grey, a list a colour
        ({"brdf": {"model": "lambert", "albedo": -0.5}}, "/brdf/albedo", "or equal to 0"),
        ({"brdf": {"model": "lambert", "albedo": [0, 2, 0]}}, "/brdf/albedo/1", "or equal to 1"),
        ({"brdf": {"model": "lambert", "albedo": [0, 0]}}, "/brdf/albedo/2", "Field required"),
        ({"brdf": {"model": "lambert", "albedo": "red"}}, "/brdf/albedo", "a valid number"),
        # neither: all that it may be
        ({"brdf": 3}, "/brdf", "valid string; or: Input should be an object"),
        ({"brdf": {"model": "lambert", "albedo": {}}}, "/brdf/albedo", "number; or: Input"),
        ({"materials": {"a": {"brdf": {"model": "ggx", "alpha": 7}}}}, "/materials/a/brdf/alpha",
         "or equal to 1"),
        ({"tangents": "vu"}, "/tangents", "'horizontal' or 'uv'"),
        ({"tangents": [0, 0, 0]}, "/tangents", "a direction needs a length"),
        ({"kind": "backe"}, "/kind", "'backe' is none of 'bake'"),
    ],
)  # fmt: skip
def test_of_a_union_what_the_input_meant_is_told(
    http: httpx.Client, change: dict[str, Any], pointer: str, said: str
) -> None:
    body = {"kind": "bake", "mesh": "mesh-00000000000000aa", "brdf": {"model": "lambert"}} | change
    problem = http.post("/v1/jobs", json=body).json()
    assert [entry["pointer"] for entry in problem["errors"]] == [pointer], problem
    assert (problem["status"], problem["pointer"]) == (422, pointer)
    assert said in problem["detail"]
    assert ("or:" in problem["detail"]) == ("or:" in said)


def test_a_registered_brdf_is_told_the_same(http: httpx.Client) -> None:
    answer = http.post("/v1/brdfs", json={"spec": {"model": "lambert", "albedo": -0.5}})
    assert answer.json()["errors"] == [
        {"pointer": "/spec/albedo", "detail": "Input should be greater than or equal to 0"}
    ]


def test_a_header_silences_nothing_of_the_body() -> None:
    header = {"loc": ("header", "idempotency-key"), "msg": "too long", "type": "string_too_long"}
    body = {"loc": ("body",), "msg": "no object", "type": "model_attributes_type"}
    entries = validation_entries([header, body], [1])
    assert [entry["detail"] for entry in entries] == [
        "header parameter idempotency-key: too long",
        "Input should be an object",
    ]
    # what the body's other members say at its place still does
    meant = {"loc": ("body",), "msg": "too small", "type": "too_small"}
    assert len(validation_entries([header, body, meant], [1])) == 2


FORM = "application/x-www-form-urlencoded"


@pytest.mark.parametrize("path", ["meshes", "jobs", "jobs:estimate", "uploads/missing"])
@pytest.mark.parametrize(("header", "said"), [({"Content-Type": FORM}, FORM), ({}, "has no Con")])
def test_a_forgotten_header_is_named(
    http: httpx.Client, path: str, header: dict[str, str], said: str
) -> None:
    answer = http.post(f"/v1/{path}", content=b'{"builtin": {"name": "teapot"}}', headers=header)
    assert (answer.status_code, answer.json()["code"]) == (415, "unsupported-media-type")
    assert answer.json()["detail"].endswith("send the header Content-Type: application/json")
    assert said in answer.json()["detail"]


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("uploads/missing", "a JSON object with digests"),
        ("jobs", "a JSON object with kind"),
        ("meshes", "a JSON object with some of blob, builtin, format"),
    ],
)
@pytest.mark.parametrize("body", ["[1]", "3", ""])
def test_a_body_that_is_no_object_is_told_what_is_wanted(
    http: httpx.Client, path: str, said: str, body: str
) -> None:
    headers = {"Content-Type": "application/json"}
    answer = http.post(f"/v1/{path}", content=body.encode(), headers=headers)
    assert answer.status_code == 422
    assert said in answer.json()["detail"]
    assert answer.json()["pointer"] == ""

"""Budgets as they go over the wire: and nothing beside them that decides the same."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.asset_budget import SECONDS, AssetBudget
from prtbake_storage.contract.jobs import job_request_adapter

ASSET = {
    "kind": "asset",
    "mesh": "mesh-0000000000000000",
    "environment": "environment-0000000000000000",
    "brdf": {"model": "lambert"},
}
BY_ERROR, BY_BYTES = (AssetBudget.decided[limit] for limit in ("max_error", "max_bytes"))
VALUES = {"ranks": [2, 4, 4], "n_components": 4, "n_lobes": 10, "max_bytes": 10_000}


def given(name):
    """Settings of which one is given: its dotted name is of a stage and a field."""
    stage, field = name.split(".")
    return {stage: {field: VALUES.get(field, 0.01)}}


def request(**fields):
    return job_request_adapter.validate_python(ASSET | fields)


def refusal(**fields):
    with pytest.raises(ValidationError) as refused:
        request(**fields)
    (first, *_) = refused.value.errors()
    return first["loc"][-2:], first["msg"]


def test_a_request_has_a_quality_or_a_budget():
    assert request().quality == "medium"
    assert request(quality="low").quality == "low"
    budgeted = request(budget={"max_error": 0.05})
    assert budgeted.quality is None
    assert budgeted.budget.max_error == 0.05
    where, why = refusal(budget={"max_error": 0.05}, quality="low")
    assert where == ("asset", "quality")
    assert "one quality or budget" in why


def test_bytes_alone_stand_beside_a_quality():
    assert request(budget={"max_bytes": 10**6}).quality == "medium"
    assert request(budget={"max_bytes": 10**6}, quality="low").quality == "low"
    for other in ({"max_error": 0.05}, {"max_seconds": 60.0}):
        both = {"max_bytes": 10**6} | other
        assert request(budget=both).quality is None
        where, why = refusal(budget=both, quality="low")
        assert where == ("asset", "quality")
        assert "one quality or budget" in why


def test_bytes_alone_decide_the_compression():
    open_to_it = {"compress": {"n_clusters": 4}, "bake": {"n_centres": 42}}
    asked = request(budget={"max_bytes": 10**6}, settings=open_to_it)
    assert asked.planned_settings.compress == {"n_clusters": 4, "max_bytes": 10**6}
    assert asked.planned_settings.bake == asked.settings.bake == open_to_it["bake"]
    assert asked.settings.compress == {"n_clusters": 4}
    for other in ({"max_seconds": 60.0}, {"max_error": 0.05}):
        held = request(budget={"max_bytes": 10**6} | other, settings=open_to_it)
        assert held.planned_settings == held.settings
    assert request(settings=open_to_it).planned_settings.compress == {"n_clusters": 4}


def test_what_is_stored_is_read_back_as_it_was():
    for fields in ({}, {"budget": {"max_seconds": 60.0}}, {"budget": {"max_error": 0.1}},
                   {"budget": {"max_bytes": 9000}, "quality": "low"}):  # fmt: skip
        stored = request(**fields).model_dump(mode="json")
        assert job_request_adapter.validate_python(stored).model_dump(mode="json") == stored


@pytest.mark.parametrize(
    ("budget", "field"),
    [
        ({"max_error": 0.0}, "max_error"),
        ({"max_error": 1.0}, "max_error"),
        ({"max_seconds": 0.0}, "max_seconds"),
        ({"max_seconds": float("inf")}, "max_seconds"),
        ({"max_bytes": 0}, "max_bytes"),
        ({"max_bytes": 0.5}, "max_bytes"),
        ({"max_bytes": 2**53}, "max_bytes"),
        ({"max_error": 0.1, "max_minutes": 5}, "max_minutes"),
    ],
)
def test_a_budget_that_makes_no_sense_is_refused_by_its_field(budget, field):
    where, _ = refusal(budget=budget)
    assert where == ("budget", field)


def test_an_empty_budget_is_refused():
    _, why = refusal(budget={})
    assert "one at least of max_error, max_bytes, max_seconds" in why


@pytest.mark.parametrize("name", sorted(set(BY_ERROR) - set(SECONDS)))
def test_settings_that_an_error_decides_are_refused_by_name(name):
    settings = given(name)
    where, why = refusal(budget={"max_error": 0.05}, settings=settings)
    assert where == tuple(name.split("."))
    assert f"budget.max_error chooses {name}" in why
    # a time decides nothing of the kind
    assert request(budget={"max_seconds": 60.0}, settings=settings).settings


@pytest.mark.parametrize("other", [{}, {"max_seconds": 60.0}, {"max_error": 0.05}])
@pytest.mark.parametrize("name", BY_BYTES)
def test_settings_that_bytes_decide_are_refused_by_name(other, name):
    settings = given(name)
    where, why = refusal(budget={"max_bytes": 10**6} | other, settings=settings)
    assert where == tuple(name.split("."))
    assert f"chooses {name}" in why


def test_an_error_of_the_compression_stands_beside_a_time_alone():
    """Beside bytes it would leave most of them, beside an error it would decide what is left."""
    settings = {"compress": {"max_error": 0.01}}
    assert request(budget={"max_seconds": 60.0}, settings=settings).settings
    assert request(quality="low", settings=settings).settings
    for budget in ({"max_bytes": 10**6}, {"max_seconds": 60.0, "max_bytes": 10**6}):
        where, why = refusal(budget=budget, settings=settings)
        assert where == ("compress", "max_error")
        assert "budget.max_bytes chooses compress.max_error" in why


def test_a_light_of_an_error_or_of_bytes_stands_beside_bytes():
    for name, value in (("max_error", 0.01), ("max_bytes", 9000), ("max_seconds", 5.0)):
        light = {"fit_light": {name: value}}
        assert request(budget={"max_bytes": 10**6}, settings=light).settings.fit_light


@pytest.mark.parametrize("budget", [{"max_error": 0.05}, {"max_seconds": 60.0}])
@pytest.mark.parametrize("name", SECONDS)
def test_seconds_of_a_stage_are_refused_beside_a_search(budget, name):
    settings = given(name)
    where, why = refusal(budget=budget, settings=settings)
    assert where == tuple(name.split("."))
    assert f"chooses {name}" in why
    # a quality has no search, nor have bytes
    assert request(quality="low", settings=settings).settings
    assert request(budget={"max_bytes": 10**6}, settings=settings).settings


def test_eight_bits_are_refused_beside_an_error():
    settings = {"compress": {"bits": 8}}
    where, why = refusal(budget={"max_error": 0.05}, settings=settings)
    assert where == ("compress", "bits")
    assert "compress.bits" in why
    for bits in (8, 16):
        _, why = refusal(
            budget={"max_error": 0.05, "max_bytes": 10**6}, settings={"compress": {"bits": bits}}
        )
        assert "compress.bits" in why
    assert request(budget={"max_error": 0.05}, settings={"compress": {"bits": 16}}).settings


def test_a_study_searches_no_budget():
    base = ASSET | {"budget": {"max_error": 0.05}}
    with pytest.raises(ValidationError, match="searches no budget"):
        job_request_adapter.validate_python(
            {"kind": "study", "base": base, "axes": {"receiver.resolution": [4, 8]}}
        )

"""Budgets of lone bakes over the wire: one of two, and nothing beside them that decides the same."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_storage.contract.jobs import job_request_adapter

BAKE = {"kind": "bake", "mesh": "mesh-0000000000000000", "brdf": {"model": "lambert"}}


def request(**fields):
    return job_request_adapter.validate_python(BAKE | fields)


def refusal(**fields):
    with pytest.raises(ValidationError) as refused:
        request(**fields)
    (first, *_) = refused.value.errors()
    return first["loc"][-2:], first["msg"]


def test_a_bake_has_a_quality_or_a_budget_or_neither():
    assert request().budget is None
    assert request(budget={"max_bytes": 10_000}).budget.max_bytes == 10_000
    where, why = refusal(budget={"max_error": 0.1}, quality="low")
    assert where == ("bake", "budget")
    assert "one quality or budget" in why


@pytest.mark.parametrize(
    ("budget", "field"),
    [
        ({"max_error": 0.0}, "max_error"),
        ({"max_error": 1.0}, "max_error"),
        ({"max_bytes": 0}, "max_bytes"),
        ({"max_seconds": 0.0}, "max_seconds"),
        ({"max_error": 0.1, "max_minutes": 5}, "max_minutes"),
    ],
)
def test_a_budget_that_makes_no_sense_is_refused_by_its_field(budget, field):
    assert refusal(budget=budget)[0] == ("budget", field)


def test_an_error_of_zero_says_that_it_has_to_be_more():
    assert "greater than 0" in refusal(budget={"max_error": 0.0})[1]


def test_an_empty_budget_is_refused():
    assert "one at least of max_error, max_bytes, max_seconds" in refusal(budget={})[1]


@pytest.mark.parametrize("name", BakeBudget.decided["any"])
def test_settings_that_any_budget_decides_are_refused_by_name(name):
    for budget in ({"max_error": 0.1}, {"max_bytes": 10_000}, {"max_seconds": 60.0}):
        where, why = refusal(budget=budget, settings={name: 0.01})
        assert where == ("settings", name)
        assert f"the budget chooses {name}" in why
    assert request(quality="low", settings={name: 0.01}).settings


@pytest.mark.parametrize("name", BakeBudget.decided["max_error"])
def test_settings_that_an_error_decides_are_refused_beside_it_alone(name):
    where, why = refusal(budget={"max_error": 0.1}, settings={name: 0.01})
    assert where == ("settings", name)
    assert f"budget.max_error chooses {name}" in why
    assert request(budget={"max_bytes": 10_000}, settings={name: 0.01}).settings


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"basis": "sh"}, "basis 'srbf'"),
        ({"n_centres": 10242}, "2562 at most"),
        ({"bandwidth": 30.0}, "bandwidth goes with a number"),
    ],
)
def test_what_no_trial_can_choose_beside_is_refused(settings, words):
    where, why = refusal(budget={"max_error": 0.1}, settings=settings)
    assert where == ("settings", *settings)
    assert words in why
    assert request(settings=settings).settings


def test_numbers_that_are_given_are_told_from_those_that_are_not():
    """Defaults spelled out would be taken for what the budget is not to choose."""
    for settings in ({}, {"n_centres": 642, "bandwidth": 30.0}, {"cube_resolution": "auto"}):
        stored = request(budget={"max_error": 0.1}, settings=settings).model_dump(mode="json")
        assert stored["settings"] == settings
        assert job_request_adapter.validate_python(stored).model_dump(mode="json") == stored
    # without one they are spelled out, as before
    assert request().model_dump(mode="json")["settings"]["n_centres"] == 642


def test_an_asset_has_no_budget_of_its_bake():
    """Its own budget says what pictures may err by; those of stages are settings."""
    asset = BAKE | {
        "kind": "asset",
        "environment": "environment-0000000000000000",
        "settings": {"bake": {"max_error": 0.1}},
    }
    with pytest.raises(ValidationError, match="max_error"):
        job_request_adapter.validate_python(asset)


def test_a_study_searches_no_budget_of_a_bake():
    with pytest.raises(ValidationError, match="searches no budget"):
        job_request_adapter.validate_python(
            {
                "kind": "study",
                "base": BAKE | {"budget": {"max_error": 0.1}},
                "axes": {"seed": [0, 1]},
            }
        )

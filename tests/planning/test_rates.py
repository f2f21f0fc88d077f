"""Rates: what they predict, how they are kept, and what they refuse."""

import json

import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.planning.rates import SHIPPED, WIDEST_FACTOR, Rates


def test_seconds_are_amounts_by_rates_by_the_stage_s_factor():
    own = SHIPPED["bake"]
    amounts = {"tasks": 2, "rays": 1e6}
    expected = 2 * own["tasks"] + 1e6 * own["rays"]
    rates = Rates(factors={"bake": 1.5})
    assert rates.base_seconds("bake", amounts) == pytest.approx(expected, rel=1e-12)
    assert rates.stage_seconds("bake", amounts) == pytest.approx(1.5 * expected, rel=1e-12)
    # of another stage nothing is known
    assert rates.stage_seconds("join", {"tasks": 1}) == SHIPPED["join"]["tasks"]
    found = rates.all_seconds({"bake": amounts, "scattering": {"tasks": 0, "entries": 0.0}})
    assert found == {"bake": rates.stage_seconds("bake", amounts)}


def test_a_record_comes_back_as_it_was():
    doubled = {stage: {u: 2.0 * s for u, s in own.items()} for stage, own in SHIPPED.items()}
    rates = Rates(doubled, {"bake": 0.8}, "calibrate-1")
    assert Rates.from_dict(json.loads(json.dumps(rates.to_dict()))) == rates
    # negative twin: one that lost a digit is another
    changed = rates.to_dict()
    changed["seconds"]["bake"]["rays"] *= 1.0 + 1e-9
    assert Rates.from_dict(changed) != rates


def test_records_outlive_versions():
    """A unit that a record does not know is taken as shipped; one that is no more is left out."""
    rates = Rates.from_dict({
        "seconds": {"bake": {"rays": 5e-7, "forgotten": 1.0}, "gone": {"tasks": 3.0}},
        "factors": {"gone": 2.0, "bake": 1.1},
    })  # fmt: skip
    assert rates.seconds["bake"] == {**SHIPPED["bake"], "rays": 5e-7}
    assert set(rates.seconds) == set(SHIPPED)
    assert rates.factors == {"bake": 1.1}
    for nothing in (None, {}, {"seconds": None, "factors": {}, "calibration": None}):
        assert Rates.from_dict(nothing) == Rates(Rates.from_dict(nothing).seconds)
        assert Rates.from_dict(nothing).seconds == {s: dict(own) for s, own in SHIPPED.items()}


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf"), "fast", True, None])
def test_nonsense_is_refused_by_name(bad):
    with pytest.raises(SettingsError) as caught:
        Rates.from_dict({"seconds": {"bake": {"rays": bad}}})
    assert caught.value.pointer == "/bake/rays"
    with pytest.raises(SettingsError) as caught:
        Rates.from_dict({"factors": {"bake": bad}})
    assert caught.value.pointer == "/bake/factor"


def test_factors_are_bounded():
    rates = Rates.from_dict({"factors": {"bake": 1e6, "join": 1e-6}})
    assert rates.factors == {"bake": WIDEST_FACTOR, "join": 1.0 / WIDEST_FACTOR}

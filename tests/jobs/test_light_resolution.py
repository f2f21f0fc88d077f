"""Numbers that a request leaves to planning, through the stages of a job."""

import pytest

from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.report.account import projection_errors
from support.local_stages import run_stages
from support.scenes import asset_request, run_until, teapot_context

OPEN = {"cube_resolution": "auto", "n_centres": "auto", "projection_tolerance": 0.05}


@pytest.fixture(scope="module")
def request_and_context(store):
    request = asset_request(settings={"bake": OPEN})
    return request, teapot_context(store, request)


@pytest.fixture(scope="module")
def joined(store, request_and_context):
    return run_until(store, *request_and_context, "join")


def decision_of(plan):
    (decision,) = (one for one in plan["effects"] if one["effect"] == "light_resolution")
    return decision


def test_the_bake_has_the_numbers_that_were_chosen_and_the_error_that_was_predicted(store, joined):
    (planned,) = joined["plan"]
    decision = decision_of(planned["plan"])
    with open_transfer(store.local_path(joined["join"][0]["transfer"])) as transfer:
        header = transfer.header
    bake = header.provenance["bake"]
    assert header.basis.n_coeffs == bake["n_centres"] == planned["settings"]["bake"]["n_centres"]
    assert bake["cube_resolution"] == planned["settings"]["bake"]["cube_resolution"]
    assert f"{bake['n_centres']} centres and 6 x {bake['cube_resolution']}^2" in decision["reason"]
    assert decision in header.provenance["effects"]
    assert decision["taken"]
    assert not decision["forced"]

    reported = projection_errors(planned["plan"]["parts"], joined["bake"])
    for name, predicted in decision["evidence"]["predicted_error_of"].items():
        # both are samples of 10 %
        assert predicted == pytest.approx(reported[f"{name} in other directions"], rel=0.3)
    assert decision["evidence"]["predicted_error"] <= 0.05
    # negative twin: one step of centres fewer leaves more than was asked for
    fewer = {162: 42, 42: 12}[bake["n_centres"]]
    request = asset_request(settings={"bake": {"n_centres": fewer, "cube_resolution": 48}})
    coarse = run_until(store, request, teapot_context(store, request), "bake")
    errors = projection_errors(coarse["plan"][0]["plan"]["parts"], coarse["bake"])
    assert max(error for name, error in errors.items() if "other directions" in name) > 0.05


def test_the_numbers_given_as_they_were_chosen_make_the_same_bake(
    store, request_and_context, joined
):
    """Nothing else of a job depends on who chose; and who gives both is told of no choice."""
    (planned,) = joined["plan"]
    given = {name: planned["settings"]["bake"][name] for name in ("cube_resolution", "n_centres")}
    request = asset_request(settings={"bake": OPEN | given})
    (alone,) = run_until(store, request, teapot_context(store, request), "plan")["plan"]
    assert alone["projection"] == planned["projection"]
    assert alone["plan"]["parts"] == planned["plan"]["parts"]
    assert alone["settings"] == planned["settings"]
    assert not any(one["effect"] == "light_resolution" for one in alone["plan"]["effects"])
    # planning is told to take longer, and holds what it looks at
    tried = planned["plan"]["work"]["plan"]
    assert min(tried["trial_rays"], tried["trial_flops"]) > 0.0
    # compression is tried either way
    assert alone["plan"]["work"]["plan"]["trial_rays"] < tried["trial_rays"]


def test_an_estimate_predicts_what_the_bake_will_choose(store, request_and_context, joined):
    request, context = request_and_context
    (planned,) = joined["plan"]
    quick = {"request": {"kind": "asset", **request}}
    (found,) = run_stages(REGISTRY.stages("estimate", quick, context), store)["estimate"]
    assert decision_of(found["plan"]) == decision_of(planned["plan"])
    assert found["artefact_bytes"] == planned["plan"]["artefact_bytes"]

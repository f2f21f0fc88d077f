"""Calibration, and what jobs say of the rates that they were predicted by."""

import json

import pytest

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Measured, Results
from prtbake_workers.jobs import calibrate
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.work import done_work, learnt
from prtbake_workers.planning.rates import SHIPPED, Rates


def test_the_trials_meet_every_stage_under_names_of_their_own():
    stages = REGISTRY.stages("calibrate", {"kind": "calibrate"}, {"nonce": 5})
    names = [stage.name for stage in stages]
    assert len(set(names)) == len(names)
    assert (names[0], names[-1]) == ("inputs", "fit")
    assert {name.partition(" ")[0] for name in names[1:-1]} == set(SHIPPED) - {"report"}
    for index in range(len(calibrate.TRIALS)):
        AssetRequest.model_validate(calibrate._request(index, 5))
    # what is timed is seeded by the nonce: nothing of an earlier calibration is remembered
    inputs = stages[0].tasks(Results())
    assert len(inputs) == 2 * len(calibrate.TRIALS)
    results = Results()
    results.add(
        "inputs", [{"canonical": f"sha256:{i:064x}"} for i in range(len(inputs))],
        [Measured(1.0, 1)] * len(inputs),
    )  # fmt: skip
    (own,) = stages[1].tasks(results)
    other = REGISTRY.stages("calibrate", {"kind": "calibrate"}, {"nonce": 6})
    (theirs,) = other[1].tasks(results)
    assert own.args["mesh"] == "sha256:" + "0" * 64
    assert own.key != theirs.key


def test_the_fit_s_rates_are_what_the_job_leaves(store):
    observations = [
        {"stage": "join", "amounts": {"tasks": 1, "values": 1e6 * i}, "seconds": 3.0 + 0.1 * i}
        for i in (1, 10, 40)
    ]
    with store.scratch() as scratch:
        fitted = calibrate.fit(
            {"observations": observations}, TaskContext(store, scratch, lambda _: None)
        )
    results = Results()
    results.add("fit", [json.loads(json.dumps(fitted))], [Measured(0.1, 1)])
    finished = REGISTRY.finish("calibrate", {}, {}, results)
    assert finished.rates is not None
    rates = Rates.from_dict({"seconds": finished.rates.seconds})
    for one, told in zip(observations, finished.result["stages"], strict=True):
        predicted = rates.base_seconds("join", one["amounts"])
        assert predicted == pytest.approx(one["seconds"], rel=0.1)
        assert told["predicted"] == pytest.approx(predicted)
        # negative twin: the shipped ones are of another machine
        assert told["shipped"] < 0.8 * told["measured"]


def test_a_job_says_what_its_stages_took_over_what_was_predicted(glossy_asset):
    request, context, results = glossy_asset
    said = learnt("asset", results, context)
    work = done_work("asset", results, context)
    rates = Rates()
    for stage, ratio in said.ratios.items():
        measured = sum(one.seconds for one in results.measured(stage))
        assert ratio * rates.base_seconds(stage, work[stage]) == pytest.approx(measured)
    assert set(said.ratios) == {
        "plan", "bake", "bounces", "add_bounces", "join", "compress", "quantise", "fit_light",
        "render", "validate", "report",
    }  # fmt: skip
    assert said.calibration is None
    # rates twice as slow halve the ratios; factors, which are what is being learnt, leave them
    slow = {stage: {u: 2 * s for u, s in own.items()} for stage, own in SHIPPED.items()}
    told = {"seconds": slow, "factors": {"bake": 3.0}, "calibration": "calibrate-1"}
    other = learnt("asset", results, context | {"rates": told})
    assert other.calibration == "calibrate-1"
    assert other.ratios["bake"] == pytest.approx(said.ratios["bake"] / 2)
    assert REGISTRY.finish("asset", request, context, results).rates == said


def test_what_ran_before_teaches_nothing(glossy_asset):
    _, context, results = glossy_asset
    again = Results()
    for stage in results:
        again.add(
            stage, results[stage], results.measured(stage), recalled=stage in ("bake", "render")
        )
    said = learnt("asset", again, context)
    assert not {"bake", "render"} & set(said.ratios)
    assert "join" in said.ratios


def test_rates_lead_predictions_alone(glossy_asset):
    """Every task but the report's, and with it every file, is the same whatever was learnt."""
    request, context, results = glossy_asset
    slow = {stage: {u: 9 * s for u, s in own.items()} for stage, own in SHIPPED.items()}
    other = context | {"rates": {"seconds": slow, "factors": {"bake": 2.0}, "calibration": "c"}}
    plain, taught = (REGISTRY.stages("asset", request, given) for given in (context, other))
    for one, two in zip(plain, taught, strict=True):
        keys = [[task.key for task in stage.tasks(results)] for stage in (one, two)]
        assert (keys[0] == keys[1]) == (one.name != "report"), one.name

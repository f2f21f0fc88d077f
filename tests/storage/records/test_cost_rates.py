"""Rates of the cost model in the records: the newest calibration, and what jobs teach."""

import math

import pytest

from prtbake_storage.contract.jobs import JobState, Progress
from prtbake_storage.contract.rates import NewRates
from prtbake_storage.records import CostRates, Database, Jobs, NewJob, Runs
from prtbake_storage.records.cost_rates import MEMORY_JOBS, MOST_RATIO

SECONDS = {"bake": {"tasks": 1.0, "rays": 2e-7}, "join": {"tasks": 0.5}}


def finish(database: Database, job_id: str, rates: NewRates | None) -> bool:
    """Take a job to its end, and let it say what it says."""
    Jobs(database).create(NewJob(id=job_id, kind="asset", request={}))
    runs = Runs(database)
    runs.start(job_id)
    return runs.succeed(job_id, result={}, artefacts=[], progress=Progress(), rates=rates)


def test_nothing_is_known_at_first(database: Database) -> None:
    assert CostRates(database).current() == {"seconds": None, "factors": {}, "calibration": None}
    finish(database, "silent", None)
    assert CostRates(database).current()["factors"] == {}


def test_the_newest_calibration_counts_and_starts_afresh(database: Database) -> None:
    finish(database, "asset-1", NewRates(ratios={"bake": 2.0}))
    assert CostRates(database).current()["factors"] == pytest.approx({"bake": 2.0})
    finish(database, "calibrate-1", NewRates(seconds=SECONDS))
    found = CostRates(database).current()
    assert found == {"seconds": SECONDS, "factors": {}, "calibration": "calibrate-1"}
    newer = {"join": {"tasks": 0.7}}
    finish(database, "calibrate-2", NewRates(seconds=newer))
    assert CostRates(database).current()["seconds"] == newer


def test_jobs_teach_by_the_mean_of_logarithms_then_forget(database: Database) -> None:
    for number, ratio in enumerate((1.0, 2.0, 4.0)):
        finish(database, f"asset-{number}", NewRates(ratios={"bake": ratio, "join": 1.0}))
    assert CostRates(database).current()["factors"] == pytest.approx({"bake": 2.0, "join": 1.0})
    # from then on it follows: half of the way after log(1/2) / log(1 - 1/8) jobs, about 5
    for number in range(40):
        finish(database, f"later-{number}", NewRates(ratios={"bake": 0.5}))
    settled = CostRates(database).current()["factors"]["bake"]
    assert settled == pytest.approx(0.5, rel=0.05)
    before = math.log(settled)
    finish(database, "odd", NewRates(ratios={"bake": 1000.0}))
    moved = math.log(CostRates(database).current()["factors"]["bake"]) - before
    assert moved == pytest.approx((math.log(MOST_RATIO) - before) / MEMORY_JOBS)


def test_what_was_predicted_by_rates_that_count_no_more_teaches_nothing(database: Database) -> None:
    finish(database, "calibrate-1", NewRates(seconds=SECONDS))
    finish(database, "old", NewRates(ratios={"bake": 3.0}))
    assert CostRates(database).current()["factors"] == {}
    # negative twin: by those that count it does
    finish(database, "new", NewRates(ratios={"bake": 3.0}, calibration="calibrate-1"))
    assert CostRates(database).current()["factors"] == pytest.approx({"bake": 3.0})


@pytest.mark.parametrize("ratio", [0.0, -1.0, float("nan"), float("inf")])
def test_ratios_that_are_none_teach_nothing(database: Database, ratio: float) -> None:
    assert finish(database, "asset-1", NewRates(ratios={"bake": ratio, "join": 1.5}))
    assert CostRates(database).current()["factors"] == pytest.approx({"join": 1.5})


def test_a_job_teaches_once_however_often_it_ends(database: Database) -> None:
    said = NewRates(ratios={"bake": 2.0})
    assert finish(database, "asset-1", said)
    runs = Runs(database)
    again = runs.succeed("asset-1", result={}, artefacts=[], progress=Progress(), rates=said)
    assert not again
    assert Jobs(database).get("asset-1").state is JobState.succeeded
    finish(database, "asset-2", NewRates(ratios={"bake": 0.5}))
    # a mean of two; of three it would be 2 ** (1/3)
    assert CostRates(database).current()["factors"] == pytest.approx({"bake": 1.0})


def test_a_calibration_takes_the_place_of_a_deleted_one_of_its_id(database: Database) -> None:
    finish(database, "cal", NewRates(seconds=SECONDS))
    finish(database, "asset-1", NewRates(ratios={"bake": 3.0}, calibration="cal"))
    assert CostRates(database).current()["factors"] == pytest.approx({"bake": 3.0})
    Jobs(database).delete("cal")
    newer = {"join": {"tasks": 0.7}}
    finish(database, "cal", NewRates(seconds=newer))
    found = CostRates(database).current()
    assert found == {"seconds": newer, "factors": {}, "calibration": "cal"}

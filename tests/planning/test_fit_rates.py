"""Rates fitted to what stages took, against rates that made it."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.planning.fit_rates import Observation, fit_rates
from prtbake_workers.planning.rates import SHIPPED, Rates

STAGE = "bake"


def observed(rng, truth, count, noise=0.0):
    """Jobs of all sizes, whose units take what ``truth`` says."""
    found = []
    for _ in range(count):
        amounts = {"tasks": float(rng.integers(1, 9))} | {
            # from a tenth of a second to ten of each
            unit: 10.0 ** rng.uniform(-1, 1) / SHIPPED[STAGE][unit]
            for unit in SHIPPED[STAGE]
            if unit != "tasks"
        }
        seconds = Rates(truth).base_seconds(STAGE, amounts)
        found.append(Observation(STAGE, amounts, seconds * np.exp(noise * rng.standard_normal())))
    return found


def machine(rng, shift, spread):
    own = {u: s * np.exp(shift + spread * rng.standard_normal()) for u, s in SHIPPED[STAGE].items()}
    return {**{s: dict(units) for s, units in SHIPPED.items()}, STAGE: own}


def test_the_rates_of_another_machine_are_found(rng):
    truth = machine(rng, 0.7, 0.3)
    fitted = fit_rates(observed(rng, truth, 40, noise=0.05))
    held_out = observed(rng, truth, 40)
    ratios = [Rates(fitted).base_seconds(STAGE, one.amounts) / one.seconds for one in held_out]
    # 5 % of noise over 40 jobs leave 1 to 3 %
    assert max(abs(np.log(ratios))) < 0.08
    # negative twin: the prior is far off
    shipped = [Rates().base_seconds(STAGE, one.amounts) / one.seconds for one in held_out]
    assert min(abs(np.log(shipped))) > 0.3
    # what nothing was observed of stays
    assert {s: own for s, own in fitted.items() if s != STAGE} == {
        s: dict(own) for s, own in SHIPPED.items() if s != STAGE
    }


def test_one_job_moves_all_units_of_its_stage_together(rng):
    truth = {s: {u: 2.0 * v for u, v in own.items()} for s, own in SHIPPED.items()}
    (one,) = observed(rng, truth, 1)
    fitted = fit_rates([one])[STAGE]
    moved = np.array([fitted[unit] / SHIPPED[STAGE][unit] for unit in fitted])
    assert Rates({**truth, STAGE: fitted}).base_seconds(STAGE, one.amounts) == pytest.approx(
        one.seconds, rel=0.02
    )
    assert moved.min() > 1.3
    assert moved.max() < 3.0


def test_one_job_that_slept_does_not_lead(rng):
    truth = machine(rng, 0.0, 0.0)
    jobs = observed(rng, truth, 20, noise=0.02)
    slept = [*jobs, Observation(STAGE, jobs[0].amounts, 50.0 * jobs[0].seconds)]
    probe = observed(rng, truth, 10)
    predicted = [Rates(fit_rates(slept)).base_seconds(STAGE, one.amounts) for one in probe]
    assert predicted == pytest.approx([one.seconds for one in probe], rel=0.1)


def test_the_same_observations_give_the_same_rates(rng):
    jobs = observed(rng, machine(rng, 0.3, 0.2), 10, noise=0.05)
    assert fit_rates(jobs) == fit_rates(list(jobs))
    assert fit_rates([]) == {s: dict(own) for s, own in SHIPPED.items()}


@pytest.mark.parametrize(
    ("one", "pointer"),
    [
        (Observation("sleeping", {"tasks": 1}, 1.0), "/stage"),
        (Observation(STAGE, {"tasks": 1}, 0.0), "/seconds"),
        (Observation(STAGE, {"tasks": 1}, float("nan")), "/seconds"),
        (Observation(STAGE, {"sheep": 1}, 1.0), "/amounts/sheep"),
        (Observation(STAGE, {"rays": -1.0}, 1.0), "/amounts/rays"),
        (Observation(STAGE, {"rays": float("inf")}, 1.0), "/amounts/rays"),
    ],
)
def test_nonsense_is_refused_by_name(one, pointer):
    with pytest.raises(SettingsError) as caught:
        fit_rates([one])
    assert caught.value.pointer == pointer

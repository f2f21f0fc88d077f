"""When the trial of a lone bake has tried enough centres."""

import pytest

from prtbake_workers.planning.bake_search import AIM, BOUNCE_SHARE
from prtbake_workers.planning.light_resolution import Candidate
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.trial_bounds import (
    LEAST_LEFT,
    LITTLE,
    SURE,
    TRIAL_SHARE,
    TrialTime,
    is_enough,
)

AIMED = (AIM * 0.1) ** 2


def tried(*errors):
    """A pair of 42 centres that leaves so much of each part."""
    return [Candidate(42, 12, errors, errors)]


def told(*losses, bounced=False, left_out=0.0):
    """A trial whose options of terms lose so much of the first of two parts."""
    options = [{"lost": [lost, 0.0]} for lost in losses]
    return {"options": options, "left_out": left_out, "bounced": bounced}


def test_what_terms_leave_counts_beside_what_centres_do():
    """Terms that are given leave 4.5e-3 of the 9e-3 that are aimed at."""
    assert not is_enough(told(4.5e-3), tried(6.0e-3, 1e-3), 0.1)
    assert is_enough(told(4.5e-3), tried(3.0e-3, 1e-3), 0.1)
    # more terms, where there are any to choose, make room for it
    assert is_enough(told(4.5e-3, 1e-5), tried(6.0e-3, 1e-3), 0.1)
    # what a part leaves is not added to what another does
    assert is_enough(told(4.5e-3), tried(3.0e-3, 6.0e-3), 0.1)
    assert not is_enough(told(4.5e-3), tried(3.0e-3, 6.4e-3), 0.1)


@pytest.mark.parametrize("others", [{"bounced": True}, {"left_out": BOUNCE_SHARE * 0.01}])
def test_bounces_and_effects_that_are_left_out_take_their_share(others):
    room = SURE * (AIMED - BOUNCE_SHARE * 0.01)
    assert is_enough(told(0.0, **others), tried(0.99 * room, 0.0), 0.1)
    assert not is_enough(told(0.0, **others), tried(1.01 * room, 0.0), 0.1)
    assert is_enough(told(0.0), tried(1.01 * room, 0.0), 0.1)


def test_centres_that_leave_next_to_nothing_are_enough_whatever_the_rest_does():
    """More of them would not help."""
    assert is_enough(told(1.05 * AIMED), tried(0.9 * LITTLE * AIMED, 0.0), 0.1)
    assert not is_enough(told(1.05 * AIMED), tried(1.1 * LITTLE * AIMED, 0.0), 0.1)


def test_without_an_error_they_are_enough_where_they_leave_hardly_anything():
    assert is_enough(told(0.5), tried(0.9 * LEAST_LEFT, 0.0), None)
    assert not is_enough(told(0.0), tried(1.1 * LEAST_LEFT, 0.0), None)


def test_rays_and_products_of_all_that_is_tried_share_what_planning_leaves():
    rates = Rates.from_dict(None)
    unit = rates.seconds["plan"]
    planned = {"vertices": 2.0 / unit["vertices"]}
    time = TrialTime(12.0, rates, planned)
    half = 0.5 * TRIAL_SHARE * 10.0
    work = {"trial_rays": half / unit["trial_rays"], "trial_flops": half / unit["trial_flops"]}
    factor = rates.factors.get("plan", 1.0)
    assert factor == 1.0
    assert time.holds({name: 0.99 * amount for name, amount in work.items()})
    for name in work:
        assert not time.holds(work | {name: 1.05 * work[name]})
    # what is named would do, for planning too
    more = {name: 2.999 * amount for name, amount in work.items()}
    words = time.refusal(42, more)
    assert TrialTime(32.0, rates, planned).holds(more)
    assert not TrialTime(31.0, rates, planned).holds(more)
    assert words == (
        "12 s are too few: trying 42 centres may take a tenth of what planning leaves, "
        "which is predicted to need a time of 32 s at least"
    )

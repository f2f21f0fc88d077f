"""Decisions of a search for a bake, on scenes whose errors, bytes and seconds are made up."""

from dataclasses import replace
from math import ceil, sqrt

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_workers.planning.bake_model import (
    BakeModel,
    Told,
    effects_left_out,
    sized,
)
from prtbake_workers.planning.bake_refusal import LATER_SIZE
from prtbake_workers.planning.bake_search import (
    AIM,
    BOUNCE_SHARE,
    MOST_BAKES,
    MOST_REST,
    UNBOUNDED,
    WINDOW,
    bounce_tolerance,
    choose,
    delivered,
    meets,
)
from prtbake_workers.planning.time_search import MARGIN
from support.made_up_bakes import COARSEST, UNTIMED, left, made, model_of, searched, trial


def test_a_line_between_resolutions_is_a_power_and_meets_what_was_tried():
    model = model_of()
    seen = model.foreseen(None, 0.0)
    rows = {choice: row for row, choice in enumerate(model.choices)}
    for fine in (17, 24, 48):
        found = seen.projection[rows[642, fine, 0]]
        assert found == pytest.approx([left(642, fine), left(642, fine, 0.3)], rel=1e-12)
    between = seen.projection[rows[642, 30, 0], 0]
    slope = np.log(left(642, 48) / left(642, 24)) / np.log(2.0)
    assert between == pytest.approx(left(642, 24) * (30 / 24) ** slope, rel=1e-12)


def test_sizes_are_those_of_the_trial_where_it_knows_them():
    known = trial()
    model = BakeModel(known)
    row = model.choices.index((12, 8, 2))
    assert model.foreseen(None, 0.0).sizes[row] == sized(known, 12, [4, 1])
    assert sized(known, 42, [4, 1]) > 2 * sized(known, 12, [4, 1]) - 20_000


def test_what_was_predicted_to_leave_nothing_is_taken_to_leave_what_it_does():
    """A part that the trial did not see, and terms of which none are left."""
    known = trial(scales=(1.0, 0.0))
    known["options"][-1]["lost"] = [0.0, 0.0]
    model = BakeModel(known)
    numbers = model.numbers(model.choices.index((42, 24, 5)), 0.0)
    one = made(model, numbers, off=1.2)
    told = replace(one, projection=(one.projection[0], 0.05), terms=(1e-6, 0.0))
    before, after = model.foreseen(None, 0.0), model.foreseen(told, 0.0)
    assert after.projection[:, 0] == pytest.approx(1.2 * before.projection[:, 0])
    assert (after.projection[:, 1] == 0.05).all()
    # fewer terms still leave more
    assert after.terms[:, 0] == pytest.approx(np.maximum(before.terms[:, 0], 1e-6))
    assert after.worst(model.choices.index((642, 48, 5))) == (1, "projection")


@settings(deadline=None, max_examples=60)
@given(
    target=st.floats(0.15, 0.6),
    off=st.floats(0.7, 1.4),
    terms_off=st.floats(0.8, 1.25),
)
def test_an_error_is_never_exceeded_and_reached_as_nearly_as_there_are_steps(
    target, off, terms_off
):
    model, budget = UNTIMED, BakeBudget(max_error=target)
    told, choice = searched(model, budget, off=off, terms_off=terms_off)
    assert choice.refused is None
    taken = told[delivered(model, budget, told)]
    seen = model.foreseen(None, 0.0)
    truth = (off * seen.projection + terms_off * seen.terms + 2e-5).max(axis=1)
    assert truth[model.row(taken.numbers)] <= target**2
    if taken.error < WINDOW * target:
        cheaper = model.cost < model.cost[model.row(taken.numbers)]
        assert not (cheaper & (truth <= (AIM * target) ** 2)).any()


@settings(deadline=None, max_examples=60)
@given(target=st.floats(0.1, 0.6), seed=st.integers(0, 2**32 - 1), spread=st.floats(0.0, 3.0))
def test_of_bakes_that_err_as_they_like_the_cheapest_that_keeps_an_error_is_delivered(
    target, seed, spread
):
    """Each row is off by a factor of its own: none leaves what is foretold, some twenty times it."""
    model, budget = UNTIMED, BakeBudget(max_error=target)
    rng = np.random.default_rng(seed)
    off = np.exp(spread * rng.standard_normal(len(model.choices)))
    off[rng.random(len(off)) < 0.1] = 0.0
    off[rng.random(len(off)) < 0.1] = 20.0
    told, choice = searched(model, budget, off=off)
    rows = [model.row(one.numbers) for one in told]
    assert len(set(rows)) == len(rows) <= MOST_BAKES
    seen = model.foreseen(None, 0.0)
    truth = np.sqrt((off[:, None] * seen.projection + seen.terms + 2e-5).max(axis=1))
    keeping = [row for row in rows if truth[row] <= target]
    if not keeping:
        assert choice.refused[0] == "max_error"
        why = choice.refused[1]
        if "is not met by" in why:
            assert len(told) == MOST_BAKES
            assert f"at best {truth[rows].min():.2%} was left" in why
        else:
            # neither what was made keeps it nor is what was not predicted to
            named = float(why.split("cannot be met: at best ")[1].split("%")[0]) / 100.0
            assert target - 1e-4 <= named <= truth[rows].min(initial=np.inf) + 1e-4
        return
    assert choice.refused is None
    cheapest = min(keeping, key=lambda row: model.cost[row])
    assert rows[delivered(model, budget, told)] == cheapest


def test_fine_steps_end_within_a_tenth():
    """Predictions off by a third are corrected by the first bake: the second lands."""
    model = model_of()
    for target in (0.17, 0.2, 0.24, 0.3):
        budget = BakeBudget(max_error=target)
        told, _ = searched(model, budget, off=1.35)
        assert told[0].error > target
        assert WINDOW * target <= told[1].error <= target
        assert len(told) == 2


def test_the_cheapest_that_keeps_an_error_is_delivered():
    model, budget = model_of(), BakeBudget(max_error=0.3)
    told, _ = searched(model, budget, off=0.5)
    assert len(told) > 1
    met = [one for one in told if meets(budget, one)]
    costs = [model.cost[model.row(one.numbers)] for one in met]
    assert told[delivered(model, budget, told)] is met[int(np.argmin(costs))]


def test_coarse_steps_leave_more_of_an_error_than_a_tenth_and_never_exceed_it():
    """One term, given directions: centres go in steps of four."""
    coarse = trial(glossy=False)
    coarse["candidates"] = [one for one in coarse["candidates"] if one["cube_resolution"] == 48]
    model, budget = BakeModel(coarse), BakeBudget(max_error=0.2)
    told, choice = searched(model, budget)
    assert choice.refused is None
    assert len(told) == 1
    assert told[0].error < WINDOW * 0.2
    (fewer,) = (count for count in COARSEST if count * 4 > told[0].numbers.n_centres > count)
    assert sqrt(left(fewer, 48)) > 0.2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"glossy": False}, "directions and functions leave"),
        ({"glossy": True, "scales": (1e-4, 1e-4)}, "terms leave"),
    ],
)
def test_an_error_that_nothing_reaches_is_refused_with_the_best_and_what_binds(changes, words):
    model = model_of(**changes)
    choice = choose(model, BakeBudget(max_error=0.01), [], left=None, tolerance=1e-3)
    assert choice.numbers is None
    field, why = choice.refused
    assert field == "max_error"
    best = sqrt(model.foreseen(None, 0.0).errors.min())
    assert f"at best {best:.2%} is predicted" in why
    assert "of a" in why
    assert words in why


def test_what_is_measured_to_bind_is_refused_with_what_is_left_by_that():
    """The first bake errs by twice what was foretold; the finest would, too."""
    model, budget = model_of(glossy=False), BakeBudget(max_error=0.12)
    told, choice = searched(model, budget, off=2.0)
    assert len(told) == 1
    best = sqrt(2.0 * left(642, 48) + 2e-5)
    assert 0.12 < best < told[0].error
    assert choice.refused[0] == "max_error"
    assert f"at best {best:.2%} is predicted to be left of a" in choice.refused[1]


def test_bounces_get_a_share_of_the_error_and_less_where_they_took_more():
    model, budget = model_of(bounced=True), BakeBudget(max_error=0.3)
    first = bounce_tolerance(budget, None, 1e-3)
    assert first == pytest.approx(BOUNCE_SHARE * 0.09)
    numbers = choose(model, budget, [], left=None, tolerance=1e-3).numbers
    assert numbers.bounce_tolerance == first
    within = made(model, numbers, rest=0.9 * MOST_REST * 0.09)
    assert bounce_tolerance(budget, within, 1e-3) == first
    above = made(model, numbers, rest=2.0 * MOST_REST * 0.09)
    assert bounce_tolerance(budget, above, 1e-3) == pytest.approx(first / 4.0)
    # bytes decide nothing of the kind
    assert bounce_tolerance(BakeBudget(max_bytes=1), above, 1e-3) == 1e-3
    # fewer rays do for more noise
    assert model.rays(first) < model.rays(first / 4.0)


def test_bounces_that_grow_get_more_rays_and_are_refused_where_they_still_do():
    model, budget = model_of(bounced=True), BakeBudget(max_error=0.3)
    told, choice = searched(model, budget, rest=np.inf)
    assert len(told) == MOST_BAKES
    tolerances = [one.numbers.bounce_tolerance for one in told]
    assert tolerances == pytest.approx([BOUNCE_SHARE * 0.09 / UNBOUNDED**k for k in range(4)])
    assert choice.refused[0] == "max_error"
    assert "nothing bounds what later bounces leave" in choice.refused[1]
    # once they do not, the search goes on
    mended = [*told[:1], made(model, told[1].numbers)]
    assert choose(model, budget, mended, left=None, tolerance=1e-3).refused is None


@pytest.mark.parametrize(
    ("budget", "seconds"),
    [(BakeBudget(max_bytes=10**8), None), (BakeBudget(max_seconds=100.0), 90.0)],
)
def test_bounces_that_grow_end_a_search_that_gives_them_no_more_rays(budget, seconds):
    model = model_of(bounced=True)
    told, choice = searched(model, budget, left=seconds, rest=np.inf)
    assert len(told) == 1
    assert choice.refused is None
    assert delivered(model, budget, told) == 0
    # the twin, whose bounces are bounded: a first bake for a time is followed by a better one
    told, _ = searched(model, BakeBudget(max_seconds=100.0), left=90.0)
    assert len(told) > 1


@settings(deadline=None, max_examples=60)
@given(asked=st.integers(40_000, 30_000_000), size_off=st.floats(0.9, 1.1))
@example(asked=118_165, size_off=1.0625)
def test_bytes_are_never_exceeded_and_no_better_bake_would_fit(asked, size_off):
    model, budget = UNTIMED, BakeBudget(max_bytes=asked)
    told, choice = searched(model, budget, size_off=size_off)
    if choice.refused is not None:
        assert choice.refused[0] == "max_bytes"
        # before a bake the least is a tenth too large, after one half a per cent
        least = size_off * model.foreseen(None, 0.0).sizes.min()
        assert least > min(LATER_SIZE, 1.1 * size_off) * asked - 1.0
        return
    best = told[delivered(model, budget, told)]
    seen = model.foreseen(None, 0.0)
    assert round(size_off * seen.sizes[model.row(best.numbers)]) <= asked
    # of bytes that hold the least bake alone there is no other to compare
    fitting = size_off * seen.sizes <= 0.96 * asked
    assert best.error <= 1.04 * sqrt(seen.errors[fitting].min(initial=np.inf) + 2e-5)


@pytest.mark.parametrize("more", [{}, {"max_error": 0.2}])
def test_a_prediction_that_is_above_the_bytes_by_less_than_a_tenth_is_tried(more):
    """It takes a tenth less than was foretold, and is what is delivered."""
    model = model_of()
    seen = model.foreseen(None, 0.0)
    within = seen.errors <= (1.1 * more.get("max_error", np.inf)) ** 2
    least = float(seen.sizes[within].min())
    budget = BakeBudget(max_bytes=round(0.92 * least), **more)
    first = choose(model, budget, [], left=None, tolerance=1e-3)
    assert seen.sizes[model.row(first.numbers)] == least
    told, choice = searched(model, budget, size_off=0.9)
    if not more:
        assert choice.refused is None
        assert told[delivered(model, budget, told)].size <= budget.max_bytes
    tight = BakeBudget(max_bytes=round(0.9 * least), **more)
    assert choose(model, tight, [], left=None, tolerance=1e-3).refused[0] == "max_bytes"


def test_bytes_below_all_bakes_are_refused_with_the_least():
    model = model_of()
    field, why = choose(model, BakeBudget(max_bytes=1000), [], left=None, tolerance=1e-3).refused
    assert field == "max_bytes"
    assert f"to be {ceil(model.foreseen(None, 0.0).sizes.min() / LATER_SIZE)}" in why


def test_an_error_that_takes_too_many_bytes_is_refused_with_what_it_takes():
    model = model_of()
    alone = choose(model, BakeBudget(max_error=0.2), [], left=None, tolerance=1e-3).numbers
    size = int(model.foreseen(None, 0.0).sizes[model.row(alone)])
    both = BakeBudget(max_error=0.2, max_bytes=2 * size)
    assert choose(model, both, [], left=None, tolerance=1e-3).numbers is not None
    tight = BakeBudget(max_error=0.2, max_bytes=size // 4)
    field, why = choose(model, tight, [], left=None, tolerance=1e-3).refused
    assert field == "max_bytes"
    assert "for an error of 20.00%" in why


def test_a_time_starts_with_what_is_quick_and_goes_on_by_what_it_took():
    model, budget = model_of(), BakeBudget(max_seconds=100.0)
    as_foretold, _ = searched(model, budget, left=100.0)
    slower, _ = searched(model, budget, left=100.0, slower=3.0)
    for told in (as_foretold, slower):
        assert told[0].seconds <= 3.0 * 20.0
        assert sum(one.seconds for one in told) <= 100.0
        errors = [one.error for one in told]
        assert errors == sorted(errors, reverse=True)
    assert as_foretold[-1].error < as_foretold[0].error
    assert as_foretold[-1].error < slower[-1].error


def test_a_time_that_nothing_fits_into_is_refused_with_the_least():
    model = model_of()
    choice = choose(model, BakeBudget(max_seconds=1.0), [], left=0.5, tolerance=1e-3)
    field, why = choice.refused
    assert field == "max_seconds"
    least = MARGIN * model.foreseen(None, 0.0).seconds.min()
    assert f"predicted to take {ceil(least)} s" in why


def test_an_error_that_takes_too_long_is_refused_by_the_time():
    model = model_of()
    budget = BakeBudget(max_error=0.15, max_seconds=3.0)
    field, _ = choose(model, budget, [], left=2.0, tolerance=1e-3).refused
    assert field == "max_seconds"


def test_a_search_ends_after_so_many_bakes():
    """Errors that no choice moves."""
    model, budget = model_of(), BakeBudget(max_error=0.3)
    told = []
    while (choice := choose(model, budget, told, left=None, tolerance=1e-3)).numbers is not None:
        stuck = made(model, choice.numbers)
        told.append(
            Told(stuck.numbers, (0.1, 0.1), stuck.terms, stuck.rest, stuck.size, stuck.seconds)
        )
        assert len(told) <= MOST_BAKES
    assert choice.refused[0] == "max_error"
    assert "is not met by the 4 bakes that are made: at best" in choice.refused[1]


def effect(name, *, taken=False, forced=False, cost=0.01):
    return {"effect": name, "taken": taken, "forced": forced, "predicted_error_otherwise": cost}


def test_effects_that_planning_left_count_and_those_that_a_request_left_do_not():
    assert effects_left_out([effect("interreflection")]) == 0.01
    assert effects_left_out([effect("interreflection", forced=True)]) == 0.0
    assert effects_left_out([effect("interreflection", taken=True)]) == 0.0
    # light that does not bounce bleeds no colours: counted once
    both = [effect("interreflection"), effect("colour_bleeding")]
    assert effects_left_out(both) == 0.01
    grey = [effect("interreflection", taken=True), effect("colour_bleeding")]
    assert effects_left_out(grey) == 0.01
    assert effects_left_out([effect("receiver_shadows", cost=None)]) == 0.0
